"""Evaluates the agents of a run: returns and crashes, in the world of a test or another.

rp-jax evaluate --run results/RUN --variant N=8

rp-jax evaluate --run results/RUN --set num_obstacles=30 --episodes 2000
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import tyro

from rp_jax import storage
from rp_jax.cli import errors, terminal
from rp_jax.cli.choice import Choice, chosen
from rp_jax.runs.evaluate import evaluate
from rp_jax.validate import number


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(Choice):
    """Options of `rp-jax evaluate`, which evaluates all agents of a run."""

    episodes: int = 10_000  # of each agent
    penalty: float = 0.0  # taken off the returns per unit of danger
    devices: str = "one"  # "one", "all" or "cluster"
    out: Path | None = None  # new folder for table.json and table.csv


def main(argv: Sequence[str]) -> None:
    """Runs the command; exits with 2 on bad input.

    Args:
        argv: arguments after "evaluate".
    """
    config = tyro.cli(EvaluateOptions, args=list(argv), prog="rp-jax evaluate", description=__doc__)
    with errors.bad_input():
        number("episodes", config.episodes, least=1, integer=True)
        found = chosen(config)
        folder = None if config.out is None else storage.new_folder(config.out)
    with errors.bad_input(), terminal.progress() as bar:
        table = evaluate(
            jax.random.key(config.seed),
            found.agents,
            episodes=config.episodes,
            penalty=config.penalty,
            name=found.variant,
            devices=config.devices,
            on_progress=bar,
        )
    terminal.say(str(table))
    if folder is not None:
        table.write(folder)
        terminal.say(f"results: {folder}")
