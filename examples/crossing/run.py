"""Threat, planning and evaluation of the crossing, without a shield and with it.

python -m examples.crossing.run --out results/crossing
"""

from dataclasses import dataclass, field

from examples.crossing import world
from experiments import ablation, tasks
from rp_jax.planning.loop import LoopConfig
from rp_jax.threat.build import ThreatConfig
from rp_jax.threat.fit import FitConfig
from rp_jax.validate import one_of


def model(states: int, paths: int = 64) -> ThreatConfig:
    """Sizes of a threat model that takes seconds."""
    fit = FitConfig(hidden=(64, 64), steps=8_000)
    return ThreatConfig(states, paths, sampling="preferential", prudence=0.02, fit=fit)


@dataclass(frozen=True)
class Config(tasks.Config):
    """Settings of the crossing."""

    pedestrians: int = 6  # while learning
    test_pedestrians: tuple[int, ...] = (6, 12)  # while testing
    pedestrian: ThreatConfig = field(default_factory=lambda: model(60_000))
    parked: ThreatConfig = field(default_factory=lambda: model(60_000))


def quick(recipe: str) -> Config:
    """A few minutes on two cores."""
    one_of("recipe", recipe, ["tuned"])
    return Config(episodes=4_000, planning=LoopConfig(steps=300_000, num_envs=128, batch=512))


def make_task(config: Config) -> tasks.Task:
    """What the pipeline needs to know."""
    one_of("baseline", config.baseline, ["paper"])  # there is no other, nor another fidelity
    one_of("fidelity", config.fidelity, ["released"])
    return tasks.Task(
        name="crossing",
        env=world,
        train=world.make_params(config.pedestrians),
        tests={f"{n} pedestrians": world.make_params(n) for n in config.test_pedestrians},
        threats={"pedestrian": config.pedestrian, "parked": config.parked},
        draw=None,
    )


if __name__ == "__main__":
    ablation.main("examples.crossing.run", __doc__ or "", {"quick": quick}, make_task)
