"""Finite CMDPs as environments, so that learners can be held against exact answers.

The module satisfies what learners use of `rp_jax.envs.Env`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from probe import make_pmdp

from rp_jax.envs import contract
from rp_jax.tabular import cmdp
from rp_jax.tabular.cmdp import FiniteCMDP

LIDAR_BINS = 0
SCALE = (1.0,)  # of every entry


class State(struct.PyTreeNode):
    index: jax.Array
    time: jax.Array


class Params(struct.PyTreeNode):
    cmdp: FiniteCMDP
    time_limit: jax.Array  # steps until an episode is cut short; beyond the horizon: never


def reset(key, params):
    start = params.cmdp.start
    index = jax.random.choice(key, len(start), p=start)
    return State(index=index, time=jnp.asarray(0, jnp.int32))


def step(key, state, action, params):
    """Continuous actions in [-1, 1]^2 are rounded: the first component tells the action."""
    model = params.cmdp
    if not jnp.issubdtype(action.dtype, jnp.integer):
        count = model.shape[2]
        action = jnp.clip(((action[0] + 1) / 2 * count).astype(int), 0, count - 1)
    index = jax.random.choice(key, len(model.start), p=model.transition[state.index, action])
    reached = State(index=index, time=state.time + 1)
    ended = reached.time >= model.horizon
    terminated, truncated = contract.ended(ended, reached.time, params.time_limit)
    return reached, contract.Outcome(
        reward=model.reward[state.index, action],
        danger=model.danger[state.index, action],
        terminated=terminated,
        truncated=truncated,
        goal=jnp.zeros_like(terminated),
    )


def observe(state, params):
    """(T S,) which step and state it is."""
    horizon, states, _ = params.cmdp.shape
    return jax.nn.one_hot(state.time * states + state.index, horizon * states)


def collisions(state, params):
    return {}


def num_actions(params):
    return params.cmdp.shape[2]


def pmdp_of(model, limit=10**6):
    import finite

    params = Params(cmdp=model, time_limit=jnp.asarray(limit, jnp.int32))
    return make_pmdp(finite, params, x=np.inf)


def all_states(model):
    """(T S,) every state at every step, in the order of (T, S)."""
    horizon, states, _ = model.shape
    time, index = jnp.divmod(jnp.arange(horizon * states), states)
    return State(index=index, time=time.astype(jnp.int32))


def bandit(rewards, dangers=None):
    """One state, one step: the arms' rewards and dangers are known."""
    rewards = np.asarray(rewards, float)[None]
    dangers = np.zeros_like(rewards) if dangers is None else np.asarray(dangers, float)[None]
    kernel = np.ones((1, rewards.size, 1))
    return cmdp.make(kernel, rewards, dangers, 0, gamma=1.0, beta=1.0, horizon=1)


def delayed(steps=4):
    """The first of two actions leads to where the last step pays 1, the other to where it is 0."""
    kernel, reward = np.zeros((3, 2, 3)), np.zeros((3, 2))
    kernel[0, 0, 1] = kernel[0, 1, 2] = 1
    kernel[1, :, 1] = kernel[2, :, 2] = 1
    reward[1] = 1 / (steps - 1)
    danger = np.zeros((3, 2))
    return cmdp.make(kernel, reward, danger, 0, gamma=1.0, beta=1.0, horizon=steps)
