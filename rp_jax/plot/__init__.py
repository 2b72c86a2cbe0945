"""Figures from saved results; the only importer of matplotlib. Nothing here computes results."""
