"""Experiments: one module per task; run them as `python -m experiments.NAME --help`."""
