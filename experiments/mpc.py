"""MPC (appendix G.4; tables 1 and 2): tree search in the true model, on each variant of a task.

python -m experiments.mpc --env jam --horizon 3 --variants N=8

--resume DIR, alone, goes on with an interrupted run.
"""

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax

from experiments.figures.words import counted
from experiments.paper.published import AVOIDED
from experiments.resumable import Command, main
from experiments.tasks import EXPERIMENTS
from rp_jax.baselines.mpc import Search, make_search
from rp_jax.cli import results, terminal
from rp_jax.runs.tables import Table
from rp_jax.runs.tree_search import evaluate_search
from rp_jax.validate import number, one_of


@dataclass(frozen=True)
class Config:
    """Settings of a search."""

    env: str  # circuit, jam or point_gather
    horizon: int  # steps ahead; the paper: 3, 4, 5 on Circuit, 2, 3 on Jam
    episodes: int = 1000  # per variant
    variants: tuple[str, ...] = ()  # tracks, or N=3, N=8, N=15; none given: all of them
    penalty: float | None = None  # per crash, in search and tables; default: 200 Circuit, 50 Jam;
    # Point Gather: 200 in search, 1 in tables
    limit: float = float("inf")  # danger up to which a sequence is safe; the safe ones come first
    fidelity: str = "released"  # "released" as the published numbers, "paper" as the text
    seed: int = 0
    out: Path | None = None  # folder for results; default: results/mpc-ENV-HORIZON-TIME


class Ready(NamedTuple):
    """Searches that are about to be made."""

    searches: dict[str, Search]  # by variant
    penalty: float  # in tables, per unit of danger

    @property
    def penalties(self) -> dict[str, float]:
        """The cost of danger, in the tables and in the search."""
        in_search = float(next(iter(self.searches.values())).penalty)
        return {"table": self.penalty, "search": in_search}


def prepared(config: Config) -> Ready:
    """Returns a search for each variant that is tested.

    Raises:
        ValueError: a setting is out of range.
    """
    module = EXPERIMENTS[one_of("env", config.env, EXPERIMENTS)]
    number("episodes", config.episodes, least=1, integer=True)
    number("seed", config.seed, least=0, most=2**31 - 1001, integer=True)
    settings = module.quick("tuned")
    world = module.make_world(dataclasses.replace(settings, fidelity=config.fidelity))
    for variant in config.variants:
        one_of("variants", variant, world.tests)
    penalty = settings.penalty if config.penalty is None else config.penalty
    avoided = AVOIDED.get(config.env, penalty) if config.penalty is None else penalty
    searches = {
        variant: make_search(
            world.env, world.params(variant), config.horizon, avoided, config.limit
        )
        for variant in config.variants or world.tests
    }
    return Ready(searches, penalty)


def job(config: Config, ready: Ready, folder: Path) -> None:
    """Plays all variants; writes the table and shows it."""
    with terminal.progress(f"MPC ({counted(config.horizon, 'step')})") as bar:
        found = evaluate_search(
            jax.random.key(config.seed),
            ready.searches,
            episodes=config.episodes,
            penalty=ready.penalty,
            folder=folder,
            on_progress=bar,
        )
    table = Table([{**row, "seed": config.seed} for row in found])
    table.write(folder)
    results.show_table(table)
    for row in table:
        cpu = row["cpu_seconds_per_100_actions"]
        many = row["seconds_per_100_actions_in_batch"]
        terminal.say(
            f"{row['variant']}: 100 actions take {cpu:.4f} CPU seconds one after another, "
            f"{many:.4f} seconds among many episodes"
        )


COMMAND = Command(
    name="python -m experiments.mpc",
    about=__doc__ or "",
    settings=Config,
    prepare=prepared,
    title=lambda config: f"mpc-{config.env}-{config.horizon}",
    job=job,
    facts=lambda ready: {"penalties": ready.penalties},
)

if __name__ == "__main__":
    main(COMMAND, sys.argv[1:])
