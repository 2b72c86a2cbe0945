"""Jam (figure 4, table 1): trained among 8 obstacles, tested among 3, 8 and 15.

python -m experiments.jam --preset quick
"""

import dataclasses
import sys
from dataclasses import dataclass, field
from typing import Any

from rp_jax import recipes
from rp_jax.cli import experiment
from rp_jax.cli.experiment import Experiment
from rp_jax.envs import jam
from rp_jax.planning.loop import LoopConfig
from rp_jax.runs.progress import OnProgress
from rp_jax.runs.train import RunResult, TrainConfig, World
from rp_jax.threat.build import ThreatConfig


@dataclass(frozen=True)
class Config(TrainConfig):
    """Settings of Jam."""

    penalty: float = 50.0  # taken off the return per crash in the tables
    obstacles: int = 8  # while learning
    fewest_obstacles: int | None = None  # so many to `obstacles` in each episode of learning
    test_obstacles: tuple[int, ...] = (3, 8, 15)  # while testing
    obstacle_horizon: int = 8  # steps after which the threat of an obstacle is cut
    fidelity: str = "released"  # "released" as the published numbers, "paper" as the text
    baseline: str = "paper"  # "paper": at random; "plans": braking and evading, walls jointly
    wall: ThreatConfig = field(default_factory=lambda: recipes.TUNED_WALL)  # threat of a wall point
    obstacle: ThreatConfig = field(default_factory=lambda: recipes.TUNED_OBSTACLE)  # of an obstacle


def quick(recipe: str) -> Config:
    """Minutes on two cores."""
    config = Config(planning=LoopConfig(steps=1_200_000))
    return paper(config) if recipe == "paper" else config


def full(recipe: str) -> Config:
    """What committed results are made with."""
    return dataclasses.replace(quick(recipe), seeds=10 if recipe == "tuned" else 1, episodes=20_000)


def paper(config: Config) -> Config:
    """The paper's architectures and hyperparameters (appendix G.1)."""
    return dataclasses.replace(
        config,
        wall=recipes.PAPER_WALL,
        obstacle=recipes.PAPER_OBSTACLE,
        planning=recipes.PAPER_PLANNING,
    )


def make_world(config: Any) -> World:
    """Jam with so many obstacles."""
    if not config.test_obstacles:
        raise ValueError("test_obstacles is (); it must name at least one count")
    common = {
        "obstacle_horizon": config.obstacle_horizon,
        "fidelity": config.fidelity,
        "baseline": config.baseline,
    }
    learning = {"num_obstacles": config.obstacles, "fewest": config.fewest_obstacles, **common}
    tests = {f"N={n}": {"num_obstacles": n, **common} for n in config.test_obstacles}
    return World("jam", jam, learning, tests)


def draw(run: RunResult, bar: OnProgress) -> None:
    """All figures of a run, and an animation."""
    from experiments.figures import jam_figures

    jam_figures.draw(run, bar)


PRESETS = {"quick": quick, "full": full}
EXPERIMENT = Experiment("python -m experiments.jam", __doc__ or "", PRESETS, make_world, draw)

if __name__ == "__main__":
    experiment.run(EXPERIMENT, sys.argv[1:])
