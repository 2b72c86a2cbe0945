"""rejax's DQN on Jam through a thin adapter; run by its own interpreter."""

from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.measure import Row, measure
from benchmarks.peers import environments
from benchmarks.setups import quick_tasks
from rp_jax import arrays
from rp_jax.envs import jam
from rp_jax.planning import networks
from rp_jax.planning.percept import encode

ITERATIONS = 100


class Jam:
    """Jam with the functions that rejax asks for: gymnax's, with one `done`.

    The observation is what our network sees: the pooled LIDAR and the rest, of the order of 1.
    """

    def __init__(self, discrete: Any, box: Any):
        """`discrete` and `box` are gymnax's spaces."""
        self._discrete, self._box = discrete, box
        self.default_params = jam.make_params()

    def action_space(self, params: jam.Params) -> Any:
        """The space of 15 actions."""
        return self._discrete(jam.num_actions(params))

    def observation_space(self, params: jam.Params) -> Any:
        """The space of observations, (81,) floats."""
        size = jam.LIDAR_BINS // networks.POOLS["tuned"] + len(jam.SCALE)
        return self._box(-100.0, 100.0, (size,), jnp.float32)

    def _seen(self, state: jam.State, params: jam.Params) -> jax.Array:
        seen = encode(jam.observe(state, params), jam.LIDAR_BINS, networks.POOLS["tuned"])
        return networks.features(seen, jam.SCALE)

    def reset(self, key: jax.Array, params: jam.Params) -> tuple[jax.Array, jam.State]:
        """A fresh start and its observation."""
        state = jam.reset(key, params)
        return self._seen(state, params), state

    def step(
        self, key: jax.Array, state: jam.State, action: jax.Array, params: jam.Params
    ) -> tuple[jax.Array, jam.State, jax.Array, jax.Array, dict]:
        """A step that begins anew after an end, as gymnax does: by drawing a start every time."""
        move, renew = jax.random.split(key)
        reached, outcome = jam.step(move, state, action, params)
        state = arrays.select(outcome.done, jam.reset(renew, params), reached)
        return self._seen(state, params), state, outcome.reward, outcome.done, {}


def run() -> list[Row]:
    """Measures the widths, environments, batch, updates and replay of our tuned recipe."""
    from flax import linen as nn
    from gymnax.environments import spaces
    from rejax import DQN
    from rejax.networks import DiscreteQNetwork, EpsilonGreedyPolicy

    _, config = quick_tasks()["jam"]
    planning = config.planning
    network = networks.TunedNetwork(num_actions=15, scale=jam.SCALE)
    env = Jam(spaces.Discrete, spaces.Box)
    learner = DQN.create(
        env=env,
        num_envs=planning.num_envs,
        batch_size=planning.batch,
        num_epochs=planning.updates,
        buffer_size=planning.replay // planning.num_envs * planning.num_envs,
        fill_buffer=planning.num_envs,
        polyak=1 - planning.learner.polyak,
        total_timesteps=planning.steps,
    ).replace(
        body=EpsilonGreedyPolicy(DiscreteQNetwork)(
            hidden_layer_sizes=network.hidden, action_dim=15, activation=nn.silu
        )
    )

    def program(state):
        return (jax.lax.fori_loop(0, ITERATIONS, lambda _, s: learner.train_iteration(s), state),)

    state = jax.jit(learner.init_state)(jax.random.key(0))
    state = jax.tree.map(jnp.copy, state)  # parts of it are shared, and would be given away twice
    count = ITERATIONS * planning.num_envs
    made = ("rejax DQN", "agent steps", planning.num_envs, count, program, state)
    return [measure(*made, carried=True)]


if __name__ == "__main__":
    environments.write(run())
