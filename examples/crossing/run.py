"""Threat, planning and evaluation of the crossing, without a shield and with it.

python -m examples.crossing.run --out results/crossing
"""

import sys
from dataclasses import dataclass, field
from typing import Any

from examples.crossing import world
from rp_jax import LoopConfig, ThreatConfig
from rp_jax.cli import experiment, shields
from rp_jax.cli.experiment import Experiment
from rp_jax.runs.train import TrainConfig, World
from rp_jax.threat.fit import FitConfig

SMALL = ThreatConfig(states=60_000, fit=FitConfig(hidden=(64, 64), steps=8_000))
LEARNER = LoopConfig(steps=300_000, num_envs=128, batch=512)


@dataclass(frozen=True)
class Config(TrainConfig):
    """Settings of the crossing."""

    penalty: float = 50.0  # taken off the return per crash
    episodes: int = 4_000
    planning: LoopConfig = field(default_factory=lambda: LEARNER)
    pedestrians: int = 6  # while learning
    test_pedestrians: tuple[int, ...] = (6, 12)  # while testing
    pedestrian: ThreatConfig = field(default_factory=lambda: SMALL)
    parked: ThreatConfig = field(default_factory=lambda: SMALL)


def make_world(config: Any) -> World:
    """The road with so many pedestrians."""
    shields.check(config)
    tests = {f"{n} pedestrians": {"pedestrians": n} for n in config.test_pedestrians}
    return World("crossing", world, {"pedestrians": config.pedestrians}, tests)


NAME, PRESETS = "python -m examples.crossing.run", {"quick": lambda recipe: Config()}
EXPERIMENT = Experiment(NAME, __doc__ or "", PRESETS, make_world, job=shields.job)

if __name__ == "__main__":
    experiment.run(EXPERIMENT, sys.argv[1:])
