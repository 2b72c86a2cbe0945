"""A car on a road that pedestrians cross."""
