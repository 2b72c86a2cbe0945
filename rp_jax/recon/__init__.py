"""Reconnaissance: where to start sub-R-MDPs from, and what their threats are."""
