"""Point Gather (figure 5a): apples and bombs; a crash is an episode with at least one bomb.

python -m experiments.point_gather --preset quick
"""

import dataclasses
import sys
from dataclasses import dataclass, field
from typing import Any

from rp_jax import recipes
from rp_jax.cli import experiment
from rp_jax.cli.experiment import Experiment
from rp_jax.envs import point_gather
from rp_jax.planning.loop import LoopConfig
from rp_jax.runs.progress import OnProgress
from rp_jax.runs.train import RunResult, TrainConfig, World
from rp_jax.threat.build import ThreatConfig


@dataclass(frozen=True)
class Config(TrainConfig):
    """Settings of Point Gather."""

    x: float = 0.5  # largest admissible threat
    penalty: float = 1.0  # taken off the return per bomb in the tables
    apples: int = 2  # in a room
    bombs: int = 8  # in a room, while learning
    test_bombs: tuple[int, ...] = (8, 16)  # while testing
    horizon: int = 5  # steps after which the threat of a bomb is cut
    fidelity: str = "released"  # "released" as the published numbers, "paper" as the text
    bomb: ThreatConfig = field(default_factory=lambda: recipes.TUNED_BOMB)  # of a bomb


def quick(recipe: str) -> Config:
    """Minutes on two cores."""
    config = Config(planning=LoopConfig(steps=1_200_000))
    return paper(config) if recipe == "paper" else config


def full(recipe: str) -> Config:
    """What committed results are made with."""
    return dataclasses.replace(quick(recipe), seeds=10 if recipe == "tuned" else 1, episodes=20_000)


def paper(config: Config) -> Config:
    """The paper's architectures and hyperparameters (appendix G.1)."""
    return dataclasses.replace(config, bomb=recipes.PAPER_BOMB, planning=recipes.PAPER_PLANNING)


def make_world(config: Any) -> World:
    """Point Gather with so many apples and bombs."""
    if not config.test_bombs:
        raise ValueError("test_bombs is (); it must name at least one count")

    def settings(bombs: int) -> dict[str, Any]:
        return {
            "num_apples": config.apples,
            "num_bombs": bombs,
            "horizon": config.horizon,
            "fidelity": config.fidelity,
        }

    tests = {f"{n} bombs": settings(n) for n in config.test_bombs}
    return World("point_gather", point_gather, settings(config.bombs), tests)


def draw(run: RunResult, bar: OnProgress) -> None:
    """All figures of a run, and an animation."""
    from experiments.figures import point_gather_figures

    point_gather_figures.draw(run, bar)


PRESETS = {"quick": quick, "full": full}
EXPERIMENT = Experiment(
    "python -m experiments.point_gather", __doc__ or "", PRESETS, make_world, draw
)

if __name__ == "__main__":
    experiment.run(EXPERIMENT, sys.argv[1:])
