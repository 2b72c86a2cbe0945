"""Threat, planning and evaluation of the trolley, without a shield and with it.

python -m examples.trolley.run --out results/trolley
"""

import sys
from dataclasses import dataclass, field
from typing import Any

from examples.trolley import world
from rp_jax import LoopConfig, ThreatConfig
from rp_jax.cli import experiment, shields
from rp_jax.cli.experiment import Experiment
from rp_jax.runs.train import TrainConfig, World
from rp_jax.threat.fit import FitConfig

SMALL = ThreatConfig(
    states=40_000,
    paths=16,
    test_states=1_000,
    test_paths=256,
    fit=FitConfig(hidden=(128, 128), steps=8_000),
)
LEARNER = LoopConfig(steps=200_000, num_envs=128, batch=512)


@dataclass(frozen=True)
class Config(TrainConfig):
    """Settings of the trolley."""

    penalty: float = 50.0  # taken off the return per crash
    episodes: int = 4_000
    planning: LoopConfig = field(default_factory=lambda: LEARNER)
    carts: int = 6  # while learning
    test_carts: tuple[int, ...] = (6, 12)  # while testing
    cart: ThreatConfig = field(default_factory=lambda: SMALL)


def make_world(config: Any) -> World:
    """The floor with so many carts."""
    shields.check(config)
    tests = {f"{n} carts": {"carts": n} for n in config.test_carts}
    return World("trolley", world, {"carts": config.carts}, tests)


NAME, PRESETS = "python -m examples.trolley.run", {"quick": lambda recipe: Config()}
EXPERIMENT = Experiment(NAME, __doc__ or "", PRESETS, make_world, job=shields.job)

if __name__ == "__main__":
    experiment.run(EXPERIMENT, sys.argv[1:])
