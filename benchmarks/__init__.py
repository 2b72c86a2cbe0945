"""Throughput of each stage: `python -m benchmarks`, or one of its modules alone."""
