"""Figures from saved results; only this package imports matplotlib, and it computes no results."""
