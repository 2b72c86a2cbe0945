"""A second reward in the room of Jam, with the threat function that was learned for the first.

Patrolling between two corners: no shield; no shield, but danger penalised; the shield.

python -m experiments.patrol --threat results/RUN/threat
"""

import sys
from typing import Any

from experiments import jam
from rp_jax.cli import experiment, shields
from rp_jax.cli.experiment import Experiment
from rp_jax.envs import patrol
from rp_jax.runs.train import World


def make_world(config: Any) -> World:
    """Jam's, with the other reward; threat functions do not know the difference."""
    shields.check(config)
    return jam.make_world(config)._replace(name="patrol", env=patrol)


EXPERIMENT = Experiment(
    "python -m experiments.patrol", __doc__ or "", jam.PRESETS, make_world, job=shields.job
)

if __name__ == "__main__":
    experiment.run(EXPERIMENT, sys.argv[1:])
