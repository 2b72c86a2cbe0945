"""Others on the same task and machine, in one run: `python -m benchmarks.peers`."""
