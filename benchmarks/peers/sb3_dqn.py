"""stable-baselines3's DQN on the gymnasium adapter of Jam; run by its own interpreter."""

import time

from benchmarks.measure import Row, row_of
from benchmarks.peers import environments

STEPS, REPEATS = 500, 5
START = 1000  # steps before it learns


def run() -> list[Row]:
    """One environment, as it is used most; 4 samples replayed a step, a network of the same widths.

    The network sees the raw observation (396 values), not the pooled one.
    """
    import gymnasium
    from stable_baselines3 import DQN
    from torch import nn

    import rp_jax.adapters.gymnasium  # noqa: F401 (registers the environment)

    learner = DQN(
        "MlpPolicy",
        gymnasium.make("rp_jax/Jam-v0"),
        buffer_size=200_000,
        batch_size=32,
        train_freq=8,
        learning_starts=START,
        policy_kwargs={"net_arch": [128, 64], "activation_fn": nn.SiLU},
        device="cpu",
    )
    learner.learn(START + STEPS)  # compiles, fills the replay, warms up
    rates = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        learner.learn(STEPS, reset_num_timesteps=False)
        rates.append(STEPS / (time.perf_counter() - began))
    return [row_of("stable-baselines3 DQN", "agent steps", 1, rates)]


if __name__ == "__main__":
    environments.write(run())
