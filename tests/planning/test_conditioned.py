"""One planner for all thresholds: the same admissible sets as at each of them."""

import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest

from rp_jax.envs import jam
from rp_jax.planning import conditioned, loop
from rp_jax.planning.loop import LoopConfig
from rp_jax.planning.wrapped import ranged
from rp_jax.threat.model import ThreatModel, ThreatNetwork

XS = (0.05, 0.3, 0.9)


def jam_pmdp(x):
    """Jam with threat models of random weights."""
    params = jam.make_params(3)
    models = {}
    for i, (kind, sub) in enumerate(sorted(jam.sub_rmdps(params).items())):
        network = ThreatNetwork((8,), 15)
        size = len(sub.source.features(*sub.source.sample(jax.random.key(0), sub.body)))
        weights = network.init(jax.random.key(i), jnp.zeros(size))
        scale = jnp.ones(size)
        models[kind] = ThreatModel(sub.source, weights, scale, jnp.asarray(-4.0), network)
    return probe.make_pmdp(jam, params, x, models=models)


def at(pmdp, states, x):
    wrapped = conditioned.condition(pmdp, x, x)
    count = len(states.time)
    return wrapped, conditioned.ConditionedState(states, jnp.full(count, x, jnp.float32))


@pytest.mark.parametrize("x", XS)
def test_what_is_admissible_is_what_is_admissible_at_that_threshold(x):
    pmdp = jam_pmdp(x)
    keys = jax.random.split(jax.random.key(0), 200)
    states = jax.vmap(jam.reset, (0, None))(keys, pmdp.params)
    plain = jax.jit(type(pmdp).perceive)(pmdp, states)
    wrapped, marked = at(pmdp, states, x)
    found = jax.jit(type(wrapped).perceive)(wrapped, marked)
    np.testing.assert_array_equal(found.admissible, plain.admissible)
    np.testing.assert_array_equal(found.secure, plain.secure)
    np.testing.assert_array_equal(found.threat, plain.threat)
    np.testing.assert_array_equal(found.threshold, np.full(200, np.float32(x)))
    np.testing.assert_array_equal(plain.threshold, found.threshold)
    assert 0 < np.asarray(plain.admissible).mean() < 1


def test_each_state_is_judged_by_the_threshold_of_its_own_episode():
    pmdp = jam_pmdp(0.5)
    states = jax.vmap(jam.reset, (0, None))(jax.random.split(jax.random.key(0), 60), pmdp.params)
    xs = jnp.asarray(np.tile(XS, 20), jnp.float32)
    wrapped = conditioned.condition(pmdp, 0.05, 0.9)
    found = jax.jit(type(wrapped).perceive)(wrapped, conditioned.ConditionedState(states, xs))
    np.testing.assert_array_equal(found.threshold, xs)
    within = np.asarray(found.threat) <= np.asarray(xs)[:, None]
    np.testing.assert_array_equal(found.secure, within.any(axis=1))
    secure = np.asarray(found.secure)
    np.testing.assert_array_equal(found.admissible[secure], within[secure])
    assert 0 < within[:, 0].mean() < 1


def test_without_a_shield_all_is_admissible_at_any_threshold():
    pmdp = probe.make_pmdp(probe, probe.make_params(), x=np.inf)
    beside = jax.vmap(probe.start_at)(jnp.asarray([5.0, 6.0]))
    wrapped, marked = at(pmdp, beside, 0.01)
    percept = wrapped.perceive(marked)
    assert percept.admissible.all()
    np.testing.assert_array_equal(percept.threat, 0)


def test_the_threshold_is_seen_after_all_else():
    pmdp = probe.make_pmdp(probe, probe.make_params())
    wrapped = conditioned.condition(pmdp, 0.01, 1.0)
    state = conditioned.ConditionedState(probe.start_at(3), jnp.asarray(0.1))
    seen = wrapped.env.observe(state, wrapped.params)
    np.testing.assert_array_equal(seen[:-1], probe.observe(state.inner, pmdp.params))
    assert seen[-1] == pytest.approx(-0.5)  # half of log10 of 0.1
    assert len(wrapped.env.SCALE) == len(seen) - wrapped.env.LIDAR_BINS


def test_thresholds_are_spread_over_the_orders_of_magnitude():
    env = conditioned.Conditioned(probe)
    params = ranged(probe.make_params(), 1e-4, 1e-1)
    keys = jax.random.split(jax.random.key(1), 3000)
    states = jax.vmap(env.reset, (0, None))(keys, params)
    digits = np.log10(np.asarray(states.x))
    assert digits.min() >= -4 - 1e-5
    assert digits.max() <= -1 + 1e-5
    counts, _ = np.histogram(digits, bins=3, range=(-4, -1))
    assert (np.abs(counts - 1000) < 120).all()


def test_the_threshold_stays_for_the_episode_and_is_drawn_anew_after_it():
    pmdp = conditioned.condition(probe.make_pmdp(probe, probe.make_params()), 0.01, 1.0)
    config = LoopConfig(
        steps=400, num_envs=4, batch=32, replay=512, replay_start=64, n_step=2, explore_share=0.5
    )
    with jax.numpy_rank_promotion("allow"):
        state, _ = jax.jit(loop.init, static_argnums=2)(jax.random.key(2), pmdp, config)
        for _ in range(20):
            before = state.states
            state, metrics = jax.jit(loop.collect, static_argnums=2)(state, pmdp, config)
            same = np.asarray(state.states.time) == np.asarray(before.time) + 1
            kept = np.asarray(state.states.x) == np.asarray(before.x)
            np.testing.assert_array_equal(kept, same)
            assert metrics.inadmissible == 0


@pytest.mark.parametrize(("low", "high", "field"), [(0.0, 1.0, "low"), (0.1, 0.01, "high")])
def test_a_range_without_thresholds_is_refused(low, high, field):
    with pytest.raises(ValueError, match=f"^{field} is "):
        ranged(probe.make_params(), low, high)
