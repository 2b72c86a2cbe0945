"""All benchmarks, one after another."""

import argparse
from collections.abc import Callable
from pathlib import Path

from benchmarks import adapters, env_step, recon, tabular, threat_query, train_step
from benchmarks.measure import Row, report

BENCHMARKS: dict[str, Callable[[], list[Row]]] = {
    "env_step": env_step.run,
    "recon": recon.run,
    "threat_query": threat_query.run,
    "train_step": train_step.run,
    "tabular": tabular.run,
    "adapters": adapters.run,
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"))
    folder = parser.parse_args().out
    for name, run in BENCHMARKS.items():
        report(name, run(), folder)
