"""Tiny problems that each isolate one fault; every on-policy learner must solve them."""

import dataclasses
import functools

import finite
import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from learning import ROLLOUT, danger_and_return

from rp_jax import evaluation
from rp_jax.baselines import actor_critic, cpo, pid_lagrangian
from rp_jax.baselines.cpo import CPOConfig
from rp_jax.baselines.pid_lagrangian import PIDConfig

LEARNERS = {
    "CPO": (cpo, CPOConfig()),
    "PID": (pid_lagrangian, PIDConfig(learning_rate=1e-3, integral=0.02)),
}
every_learner = pytest.mark.parametrize("name", LEARNERS)


@functools.partial(jax.jit, static_argnums=(3, 4, 5))
def learn(key, pmdp, limit, module, config, count):
    def one(state, _):
        return module.step(state, pmdp, limit, config)

    state, _ = jax.lax.scan(one, module.init(key, pmdp, config), None, length=count)
    return state.actor if module is cpo else state.learner.actor


def learned(name, pmdp, limit, rollout, count):
    module, config = LEARNERS[name]
    config = dataclasses.replace(config, rollout=rollout)
    key = jax.random.key(1)
    return learn(key, pmdp, jnp.asarray(limit, jnp.float32), module, config, count)


def solved(name, model, limit):
    pmdp = finite.pmdp_of(model)
    return danger_and_return(model, pmdp, learned(name, pmdp, limit, ROLLOUT, 60))


@pytest.mark.slow
@every_learner
def test_what_an_action_earns_is_seen(name):
    _, value = solved(name, finite.bandit([0.0, 1.0, 0.5]), 1.0)
    assert value > 0.95


@pytest.mark.slow
@every_learner
def test_credit_reaches_back_over_time(name):
    _, value = solved(name, finite.delayed(steps=4), 1.0)
    assert value > 0.95


@every_learner
def test_a_tempting_danger_is_taken_as_often_as_is_allowed(name):
    danger, value = solved(name, finite.bandit([1.0, 2.0], [0.0, 1.0]), 0.25)
    assert danger == pytest.approx(0.25, abs=0.08)
    assert value == pytest.approx(1 + danger, abs=1e-4)


@pytest.mark.slow
@every_learner
@pytest.mark.parametrize("limit", [0.02, 1.0])
def test_continuous_actions_reach_the_coin_or_the_bait(name, limit):
    """The corridor: the pit pays more than the coin, unless danger counts."""
    rollout = dataclasses.replace(ROLLOUT, policy="gaussian", gamma=0.95, beta=0.95)
    pmdp = probe.make_pmdp(probe, probe.make_params(), x=np.inf)
    actor = learned(name, pmdp, limit, rollout, 60)
    network = actor_critic.make_actor(pmdp, rollout)

    @jax.jit
    def play(actor, pmdp):
        policy = actor_critic.driver(network, actor)
        return evaluation.play_episodes(jax.random.key(2), pmdp, policy, 500, batch=500)

    found = evaluation.summarise(play(actor, pmdp), 0.0)
    if limit == 1.0:
        assert found["crash_rate"] > 0.9
    else:
        assert found["crash_rate"] < 0.08
        assert found["goal_rate"] > 0.85
