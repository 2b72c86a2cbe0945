"""All benchmarks, one after another."""

from collections.abc import Callable

from benchmarks import adapters, env_step, recon, seeds, tabular, threat_query, train_step
from benchmarks.measure import Row
from benchmarks.report import command_line

BENCHMARKS: dict[str, Callable[[], list[Row]]] = {
    "env_step": env_step.run,
    "recon": recon.run,
    "threat_query": threat_query.run,
    "train_step": train_step.run,
    "seeds": seeds.run,
    "tabular": tabular.run,
    "adapters": adapters.run,
}

if __name__ == "__main__":
    command_line("python -m benchmarks", BENCHMARKS)
