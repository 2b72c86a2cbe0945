"""Figures of the paper's tasks, from finished runs; need matplotlib."""
