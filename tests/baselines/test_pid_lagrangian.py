import dataclasses
import functools

import finite
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from learning import ROLLOUT, danger_and_return
from quick import unoptimised
from tabular import cases

from rp_jax.baselines import pid_lagrangian
from rp_jax.baselines.actor_critic import Batch, Recent
from rp_jax.baselines.pid_lagrangian import Controller, PIDConfig
from rp_jax.baselines.policies import Categorical
from rp_jax.tabular import exact, oracle

CONFIG = PIDConfig(rollout=ROLLOUT, learning_rate=1e-3)
TRACED = []

init = jax.jit(pid_lagrangian.init, static_argnums=2)


@pytest.fixture
def compile_soon():
    with unoptimised():
        yield


@functools.partial(jax.jit, static_argnums=(3, 4))
def learn(state, pmdp, limit, config, count):
    TRACED.append(config)

    def one(state, _):
        return pid_lagrangian.step(state, pmdp, limit, config)

    return jax.lax.scan(one, state, None, length=count)


def test_the_three_terms_by_hand():
    config = PIDConfig(proportional=2.0, integral=0.5, derivative=3.0)
    controller = Controller(jnp.zeros(()), jnp.zeros(()))
    found = []
    for danger in (0.5, 0.3, 0.4, 0.0, 0.0):
        controller, penalty = pid_lagrangian.control(
            controller, jnp.asarray(danger), jnp.asarray(0.2), config
        )
        found.append((float(controller.integral), float(penalty)))
    expected = [
        (1.5, 2 * 1.5 + 0.5 * 1.5 + 3 * 2.5),  # in units of the limit
        (2.0, 2 * 0.5 + 0.5 * 2.0),  # a fall counts for nothing
        (3.0, 2 * 1.0 + 0.5 * 3.0 + 3 * 0.5),
        (2.0, 0.0),  # 2 * -1 + .5 * 2 is not above 0
        (1.0, 0.0),
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    for _ in range(3):
        controller, _ = pid_lagrangian.control(controller, jnp.zeros(()), jnp.asarray(0.2), config)
    assert controller.integral == 0  # it does not wind up on the safe side
    controller, _ = pid_lagrangian.control(controller, jnp.ones(()), jnp.asarray(1e-3), config)
    assert controller.integral == pid_lagrangian.FAR  # nor by what a fresh policy does


def test_the_penalty_shares_the_objective_with_the_reward():
    advantage = jnp.asarray([[1.0, 0.5], [-2.0, 1.0]])
    found = pid_lagrangian.penalised(advantage, jnp.asarray(3.0))
    np.testing.assert_allclose(found, [1.0, -1.0], rtol=1e-4)  # 1 - 1.5 and -2 - 3, standardised
    many = jnp.asarray([[1.0, 0.5], [-2.0, 1.0], [0.5, 0.0]])
    found = pid_lagrangian.penalised(many, jnp.asarray(3.0))
    plain = np.asarray([1 - 1.5, -2 - 3, 0.5])
    np.testing.assert_allclose(found, (plain - plain.mean()) / plain.std(), rtol=1e-4)


def test_the_objective_is_clipped_on_the_side_of_gain():
    class Network:
        @staticmethod
        def apply(params, encoded):
            return Categorical(params)

    before = jnp.log(jnp.full(4, 0.5))
    logits = jnp.log(jnp.asarray([[0.75, 0.25]] * 4))
    actions = jnp.asarray([0, 0, 1, 1])  # ratios 1.5 and .5
    gain = jnp.asarray([1.0, -1.0, 1.0, -1.0])
    batch = Batch(None, None, actions, gain, gain)
    found = pid_lagrangian.objective(logits, Network, batch, gain, before, 0.2)
    assert found == pytest.approx((1.2 - 1.5 + 0.5 - 0.8) / 4)
    grads = jax.grad(pid_lagrangian.objective)(logits, Network, batch, gain, before, 0.2)
    np.testing.assert_array_equal(np.abs(grads).sum(axis=-1) > 0, [False, True, True, False])


def test_a_batch_moves_the_policy_only_so_far(compile_soon):
    pmdp = finite.pmdp_of(finite.bandit([0.0, 1.0, 0.5]))

    def distance(divergence):
        config = dataclasses.replace(CONFIG, divergence=divergence)
        begun = init(jax.random.key(0), pmdp, config)
        after, _ = learn(begun, pmdp, jnp.asarray(1.0), config, 1)
        moved = jax.tree.map(jnp.subtract, after.learner.actor, begun.learner.actor)
        return float(optax.tree.norm(moved))

    # The first minibatch is seen by the policy that acted, so that one is always learned from.
    assert 0 < distance(1e-9) < distance(0.01) < distance(1e9)


def test_how_far_a_policy_has_moved_is_estimated():
    class Network:
        @staticmethod
        def apply(params, encoded):
            return Categorical(jnp.broadcast_to(params, (*encoded.shape, 2)))

    old, new = jnp.log(jnp.asarray([0.5, 0.5])), jnp.log(jnp.asarray([0.75, 0.25]))
    actions = jnp.asarray([0, 1])  # as often as the old policy takes them
    batch = Batch(jnp.zeros(2), None, actions, None, None)
    before = Categorical(old).log_probs[actions]
    found = pid_lagrangian.moved(new, Network, batch, before)
    assert found == pytest.approx(float(Categorical(old).kl(Categorical(new))), abs=1e-6)
    assert pid_lagrangian.moved(old, Network, batch, before) == pytest.approx(0, abs=1e-7)


def test_a_batch_without_an_end_keeps_the_last_measure(compile_soon):
    model = finite.delayed(steps=9)
    pmdp = finite.pmdp_of(model)
    rollout = dataclasses.replace(ROLLOUT, num_envs=4, length=4, memory=0.5)
    config = dataclasses.replace(CONFIG, rollout=rollout)
    begun = init(jax.random.key(0), pmdp, config)
    recent = Recent(*map(jnp.asarray, (1.4, 2.0, 16.0)))
    controller = Controller(jnp.zeros(()), jnp.asarray(0.7))
    state = begun._replace(learner=begun.learner._replace(recent=recent), controller=controller)
    state, metrics = learn(state, pmdp, jnp.asarray(0.5), config, 1)
    assert metrics.rollout.episodes == 0
    assert state.controller.danger == pytest.approx(0.7)
    np.testing.assert_allclose(metrics.penalty, 0.1 * 0.4 + 0.01 * 0.4, rtol=1e-5)
    state, metrics = learn(begun, pmdp, jnp.asarray(0.5), config, 1)  # nothing is known at all
    assert metrics.penalty == state.controller.integral == 0


@pytest.mark.slow
def test_on_a_finite_cmdp_it_keeps_the_limit_and_comes_near_the_optimum():
    model = cases.random_cmdp(0, gamma=1.0, beta=1.0)
    least = float(exact.expected(model, exact.least_threat(model)))
    limit = 0.6 * least + 0.4 * oracle.optimum(model, np.inf).danger
    best = oracle.optimum(model, limit)
    pmdp = finite.pmdp_of(model)
    config = dataclasses.replace(CONFIG, proportional=0.5, integral=0.1, derivative=0.5)
    state = init(jax.random.key(1), pmdp, config)
    state, metrics = learn(state, pmdp, jnp.asarray(limit, jnp.float32), config, 120)
    danger, value = danger_and_return(model, pmdp, state.learner.actor)
    assert danger < limit + 0.03
    assert value > best.value - 0.15
    assert metrics.penalty[-1] > 0.1


@pytest.mark.slow
def test_limits_and_seeds_side_by_side_learn_what_each_learns_alone(compile_soon):
    model = cases.random_cmdp(3, gamma=1.0, beta=1.0)
    pmdp = finite.pmdp_of(model)
    config = dataclasses.replace(CONFIG, rollout=dataclasses.replace(ROLLOUT, num_envs=8, length=8))
    keys, limits = jax.random.split(jax.random.key(2)), jnp.asarray([0.1, 1.0])
    begun = jax.vmap(init, (0, None, None))(keys, pmdp, config)
    many = jax.jit(jax.vmap(learn, (0, None, 0, None, None)), static_argnums=(3, 4))
    _, metrics = many(begun, pmdp, limits, config, 3)
    before = len(TRACED)
    for i in range(2):
        _, mine = learn(init(keys[i], pmdp, config), pmdp, limits[i], config, 3)
        theirs = jax.tree.map(lambda a, i=i: a[i], metrics)
        np.testing.assert_allclose(mine.rollout.score, theirs.rollout.score, rtol=1e-3)
        np.testing.assert_allclose(mine.penalty, theirs.penalty, rtol=1e-3)
    assert len(TRACED) <= before + 1  # the two limits share a compilation


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"learning_rate": 0.0}, "learning_rate"),
        ({"clip": 0.0}, "clip"),
        ({"proportional": -1.0}, "proportional"),
        ({"divergence": 0.0}, "divergence"),
        ({"integral": float("inf")}, "integral"),
        ({"derivative": float("nan")}, "derivative"),
        ({"rollout": dataclasses.replace(ROLLOUT, length=0)}, r"rollout\.length"),
    ],
)
def test_bad_settings_are_named(change, field):
    CONFIG.validate("pid")
    with pytest.raises(ValueError, match=rf"^pid\.{field} is .*must"):
        dataclasses.replace(CONFIG, **change).validate("pid")
