"""Circuit (figure 6, table 2): trained on one track, tested on it, narrowed, and on a circle.

python -m experiments.circuit --preset quick
"""

import dataclasses
import sys
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rp_jax import recipes
from rp_jax.cli import experiment
from rp_jax.cli.experiment import Experiment
from rp_jax.envs import circuit
from rp_jax.envs.tracks import PLANS
from rp_jax.planning.loop import LoopConfig
from rp_jax.runs.progress import OnProgress
from rp_jax.runs.train import RunResult, TrainConfig, World
from rp_jax.threat.build import ThreatConfig
from rp_jax.validate import number, one_of


@dataclass(frozen=True)
class Config(TrainConfig):
    """Settings of Circuit."""

    x: float = 0.001  # largest admissible threat
    penalty: float = 200.0  # taken off the return per crash in the tables
    track: str = "default"  # while learning: default, narrowed or circle
    test_tracks: tuple[str, ...] = ("default", "narrowed", "circle")  # while testing
    hide_position: float = 0.0  # share of learning episodes in which x and y are not observed
    fidelity: str = "released"  # "released" as the published numbers, "paper" as the text
    baseline: str = "paper"  # "paper": at random; "plans": braking, walls jointly
    wall: ThreatConfig = field(default_factory=lambda: recipes.TUNED_WALL)  # of a wall point

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        super().validate()
        number("hide_position", self.hide_position, least=0, most=1)


def quick(recipe: str) -> Config:
    """Minutes on two cores."""
    config = Config(planning=LoopConfig(steps=1_800_000))
    return paper(config) if recipe == "paper" else config


def full(recipe: str) -> Config:
    """What committed results are made with."""
    return dataclasses.replace(quick(recipe), seeds=10 if recipe == "tuned" else 1, episodes=20_000)


def paper(config: Config) -> Config:
    """The paper's architectures and hyperparameters (appendix G.1)."""
    return dataclasses.replace(config, wall=recipes.PAPER_WALL, planning=recipes.PAPER_PLANNING)


def make_world(config: Any) -> World:
    """Circuit on a track.

    An agent that learned to do without x and y is not told them where the track leads elsewhere
    than the one that it learned on: what it knows of places is wrong there.
    """
    if not config.test_tracks:
        raise ValueError("test_tracks is (); it must name at least one track")
    for field_name, tracks in (("track", [config.track]), ("test_tracks", config.test_tracks)):
        for track in tracks:
            one_of(field_name, track, PLANS)
    common = {"fidelity": config.fidelity, "baseline": config.baseline}
    line = PLANS[config.track]().points

    def test(track: str) -> dict[str, Any]:
        elsewhere = not np.array_equal(PLANS[track]().points, line)
        hidden = float(elsewhere and config.hide_position > 0)
        return {"track": track, "hide_position": hidden, **common}

    learning = {"track": config.track, "hide_position": config.hide_position, **common}
    return World("circuit", circuit, learning, {track: test(track) for track in config.test_tracks})


def draw(run: RunResult, bar: OnProgress) -> None:
    """All figures of a run, and an animation."""
    from experiments.figures import circuit_figures

    circuit_figures.draw(run, bar)


PRESETS = {"quick": quick, "full": full}
EXPERIMENT = Experiment("python -m experiments.circuit", __doc__ or "", PRESETS, make_world, draw)

if __name__ == "__main__":
    experiment.run(EXPERIMENT, sys.argv[1:])
