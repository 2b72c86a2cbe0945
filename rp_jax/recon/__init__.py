"""Reconnaissance: estimates of threats, and the states to estimate them in."""
