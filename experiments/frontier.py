"""Return and crash rate over the threshold x in Jam, from one threat function.

Agents for all x learn side by side in one program; beside them agents that are told x. Neither
learns the threat function again.

python -m experiments.frontier --preset quick
"""

import dataclasses
import sys
from dataclasses import dataclass

from experiments import jam
from rp_jax.cli import experiment, frontier_command
from rp_jax.cli.experiment import Experiment


@dataclass(frozen=True)
class Config(jam.Config):
    """Settings: those of Jam; `x` is where the threat function was looked at closely."""

    thresholds: tuple[float, ...] = frontier_command.THRESHOLDS

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        super().validate()
        frontier_command.check(self)


def quick(recipe: str) -> Config:
    """Minutes on two cores."""
    base = jam.quick(recipe)
    fields = {f.name: getattr(base, f.name) for f in dataclasses.fields(base)}
    return Config(**{**fields, "baseline": "plans", "x": 1e-3, "episodes": 4_000})


def full(recipe: str) -> Config:
    """What committed results are made with."""
    return dataclasses.replace(quick(recipe), seeds=3, episodes=20_000)


PRESETS = {"quick": quick, "full": full}
EXPERIMENT = Experiment(
    "python -m experiments.frontier",
    __doc__ or "",
    PRESETS,
    jam.make_world,
    job=frontier_command.job,
)

if __name__ == "__main__":
    experiment.run(EXPERIMENT, sys.argv[1:])
