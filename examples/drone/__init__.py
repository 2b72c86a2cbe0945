"""A drone with momentum among drifting discs."""
