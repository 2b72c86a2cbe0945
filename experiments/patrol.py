"""A second reward in the room of Jam, with the threat function that was learned for the first.

Patrolling between two corners: no shield; no shield, but danger penalised; the shield.

python -m experiments.patrol --threat results/RUN/threat
"""

from experiments import ablation, jam, tasks
from rp_jax.envs import patrol


def make_task(config: jam.Config) -> tasks.Task:
    """That of Jam, with the other reward; threat functions do not know the difference."""
    return jam.make_task(config)._replace(env=patrol, draw=None)


if __name__ == "__main__":
    ablation.main("experiments.patrol", __doc__ or "", jam.PRESETS, make_task)
