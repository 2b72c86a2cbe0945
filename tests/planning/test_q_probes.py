"""Tiny problems that each isolate one fault; Q-learning must solve them as policies must
(tests/baselines/test_probes.py)."""

import functools

import finite
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401

from rp_jax.planning import loop
from rp_jax.planning.dqn import DQNConfig
from rp_jax.planning.loop import LoopConfig

CONFIG = LoopConfig(
    learner=DQNConfig(gamma=0.9, polyak=0.05, reward_scale=1.0, learning_rate=1e-2),
    steps=4000,
    num_envs=16,
    batch=32,
    n_step=1,
    replay=1024,
    replay_start=64,
)


@functools.partial(jax.jit, static_argnums=2)
def learn(key, pmdp, config):
    state, _ = loop.init(key, pmdp, config)
    return loop.chunk(state, pmdp, config, config.iterations)[0].learner.params


def values(model, penalty=0.0):
    """(T S, A) of every state at every step."""
    pmdp = finite.pmdp_of(model).replace(penalty=jnp.asarray(penalty))
    with jax.numpy_rank_promotion("allow"):  # flashbax's sampling needs it
        params = learn(jax.random.key(0), pmdp, CONFIG)
    encoded = pmdp.perceive(finite.all_states(model)).encoded
    return np.asarray(loop.make_network(CONFIG, pmdp).apply(params, encoded))


def test_what_an_action_earns_is_its_value():
    np.testing.assert_allclose(values(finite.bandit([0.0, 1.0]))[0], [0.0, 1.0], atol=0.05)


def test_credit_reaches_back_over_time():
    found = values(finite.delayed(steps=4))[0]
    np.testing.assert_allclose(found, [(0.9 + 0.9**2 + 0.9**3) / 3, 0.0], atol=0.05)


@pytest.mark.parametrize("penalty", [0.0, 5.0])
def test_a_tempting_danger_is_taken_unless_a_penalty_outweighs_it(penalty):
    found = values(finite.bandit([1.0, 2.0], [0.0, 1.0]), penalty)[0]
    np.testing.assert_allclose(found, [1.0, 2.0 - penalty], atol=0.1)
    assert found.argmax() == (1 if penalty == 0 else 0)
