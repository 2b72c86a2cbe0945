"""Threat, planning and evaluation of the trolley, without a shield and with it.

python -m examples.trolley.run --out results/trolley
"""

from dataclasses import dataclass, field

from examples.trolley import world
from experiments import ablation, tasks
from rp_jax.planning.loop import LoopConfig
from rp_jax.threat.build import ThreatConfig
from rp_jax.threat.fit import FitConfig
from rp_jax.validate import one_of

CART = ThreatConfig(
    states=40_000,
    paths=16,
    sampling="preferential",
    prudence=0.02,
    test_states=1_000,
    test_paths=256,
    fit=FitConfig(hidden=(128, 128), steps=8_000),
)


@dataclass(frozen=True)
class Config(tasks.Config):
    """Settings of the trolley."""

    carts: int = 6  # while learning
    test_carts: tuple[int, ...] = (6, 12)  # while testing
    cart: ThreatConfig = field(default_factory=lambda: CART)


def quick(recipe: str) -> Config:
    """A few minutes on two cores."""
    one_of("recipe", recipe, ["tuned"])
    return Config(episodes=4_000, planning=LoopConfig(steps=200_000, num_envs=128, batch=512))


def make_task(config: Config) -> tasks.Task:
    """What the pipeline needs to know."""
    one_of("baseline", config.baseline, ["paper"])  # there is no other, nor another fidelity
    one_of("fidelity", config.fidelity, ["released"])
    return tasks.Task(
        name="trolley",
        env=world,
        train=world.make_params(config.carts),
        tests={f"{n} carts": world.make_params(n) for n in config.test_carts},
        threats={"cart": config.cart},
        draw=None,
    )


if __name__ == "__main__":
    ablation.main("examples.trolley.run", __doc__ or "", {"quick": quick}, make_task)
