"""Promised danger against danger met in Jam: agents that carry a budget are promised each c.

Several threat functions, each learned anew, with several agents each; tests among more and fewer
obstacles than they learned with. Written are promises.json, a table and a figure.

python -m experiments.budgets --preset quick
"""

import dataclasses
import sys
from dataclasses import dataclass
from typing import Any

import jax

from experiments import jam
from rp_jax import storage
from rp_jax.cli import experiment, terminal
from rp_jax.cli.experiment import Experiment, Run
from rp_jax.runs import promises, tables
from rp_jax.runs.progress import OnProgress
from rp_jax.runs.train import World
from rp_jax.validate import number, one_of

PROMISED = (0.001, 0.003, 0.01, 0.03, 0.1)


@dataclass(frozen=True)
class Config(jam.Config):
    """Settings: those of Jam; `x` is where the threat functions are learned most closely."""

    promised: tuple[float, ...] = PROMISED  # danger of an episode
    threats: int = 3  # threat functions, each with `seeds` agents

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        super().validate()
        number("x", self.x, above=0, most=1)
        promises.check_promises(self.promised)
        number("threats", self.threats, least=1, most=1000, integer=True)
        one_of("c", self.c, [None])  # there are several, in `promised`


def quick(recipe: str) -> Config:
    """One threat function and agent: a quarter of an hour on two cores."""
    base = jam.quick(recipe)
    fields = {f.name: getattr(base, f.name) for f in dataclasses.fields(base)}
    own = {
        "baseline": "plans",
        "x": 2e-3,
        "lookahead": 8,
        "learning_penalty": 50.0,
        "fewest_obstacles": 0,
        "test_obstacles": (3, 8, 15, 30),
        "episodes": 1_000,
    }
    return Config(**{**fields, **own}, threats=1)


def full(recipe: str) -> Config:
    """What committed results are made with."""
    return dataclasses.replace(quick(recipe), threats=3, seeds=3, episodes=10_000)


def make_world(config: Any) -> World:
    """Jam's."""
    if not config.shield:
        raise ValueError("shield is False; it must be True, for a promise needs threats")
    return jam.make_world(config)


def job(run: Run, bar: OnProgress) -> None:
    """Learns, promises, counts; writes promises.json and the figure."""
    config: Any = run.config
    rows = promises.promises(
        jax.random.key(config.seed),
        run.world.env,
        run.world.params(),
        c=config.promised,
        x=config.x,
        tests={name: run.world.params(name) for name in run.world.tests},
        threats=config.threats,
        seeds=config.seeds,
        threat_config={
            kind: run.threats[kind]
            for kind in run.world.env.sub_rmdps(run.world.params())
            if kind in run.threats
        },
        config=config.planning,
        lookahead=config.lookahead,
        refunds=config.refunds,
        learning_penalty=config.learning_penalty,
        learning_penalty_from=config.learning_penalty_from,
        episodes=config.episodes,
        penalty=config.penalty,
        folder=run.folder,
        devices=run.process.devices,
        on_progress=bar,
    )
    storage.write_json(run.folder / "promises.json", rows)
    show(run.world.name, rows)
    if run.process.figures:
        from rp_jax.plot import curves

        curves.promises(rows, run.folder / "promises.png")


def show(name: str, rows: list[dict[str, Any]]) -> None:
    """Prints a line for each test and c."""
    shown = [
        {
            "test": row["variant"],
            "promised c": f"{row['promised']:.3g}",
            "return": tables.earned(row),
            "danger": f"{row['danger_mean']:.5f} +- {row['danger_ci95']:.5f}",
            "booked": f"{row['booked_mean']:.5f}",
            "crashes": tables.crashed(row),
            **tables.rates(row),
        }
        for row in rows
    ]
    terminal.table(f"{name}: danger promised and met", shown, list(shown[0]))


EXPERIMENT = Experiment(
    "python -m experiments.budgets",
    __doc__ or "",
    {"quick": quick, "full": full},
    make_world,
    job=job,
)

if __name__ == "__main__":
    experiment.run(EXPERIMENT, sys.argv[1:])
