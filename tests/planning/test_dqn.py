import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401

from rp_jax import shield
from rp_jax.planning import dqn
from rp_jax.planning.dqn import DQNConfig, Learner, Transition
from rp_jax.planning.percept import Encoded

CONFIG = DQNConfig(gamma=0.9, learning_rate=0.01, anneal=False, polyak=0.1, reward_scale=1.0)
UPDATES = 10


class Table:
    """A network whose weights are the action values (S, A) of states named by `rest`."""

    @staticmethod
    def apply(params, encoded):
        return params[encoded.rest[..., 0].astype(int)]


def named(*states):
    rest = jnp.asarray(states, jnp.float32)[:, None]
    return Encoded(jnp.zeros((len(states), 1), jnp.uint8), rest)


def batch(states, actions, rewards, discounts, reached, masks):
    return Transition(
        encoded=named(*states),
        action=jnp.asarray(actions, jnp.int32),
        reward=jnp.asarray(rewards, jnp.float32),
        discount=jnp.asarray(discounts, jnp.float32),
        next_encoded=named(*reached),
        next_admissible=jnp.asarray(masks, bool),
    )


def learner(params, target, config=CONFIG):
    state = dqn.optimiser(config, UPDATES).init(params)
    return Learner(params, target, state, jnp.asarray(0, jnp.int32))


@functools.partial(jax.jit, static_argnames="config")
def update(state, items, weights=None, config=CONFIG):
    weights = jnp.ones(len(items.action)) if weights is None else weights
    transform = dqn.optimiser(config, UPDATES)
    return dqn.update(state, Table, transform, items, weights, config)


ALL, NOT_LAST = [True, True, True], [True, True, False]


@pytest.mark.parametrize(
    ("mask", "expected"),
    [
        (ALL, 1 + 0.9 * 30),  # the online network prefers 2, the target values it
        (NOT_LAST, 1 + 0.9 * 10),  # of 0 and 1 it prefers 0
        ([False, True, False], 1 + 0.9 * 20),  # greedy-eta alone, where the state is not secure
    ],
)
def test_the_target_is_that_of_algorithm_4(mask, expected):
    online, target = jnp.asarray([3.0, 2.0, 5.0]), jnp.asarray([10.0, 20.0, 30.0])
    found = dqn.double_q_target(
        jnp.asarray(1.0), jnp.asarray(0.9), online, target, jnp.asarray(mask)
    )
    assert found == pytest.approx(expected)
    ended = dqn.double_q_target(
        jnp.asarray(1.0), jnp.asarray(0.0), online, target, jnp.asarray(mask)
    )
    assert ended == 1.0


@pytest.mark.parametrize("huge", [1e6, 1e30, np.inf, np.nan])
def test_inadmissible_values_do_not_reach_the_target(huge):
    online, target = jnp.asarray([3.0, 2.0, huge]), jnp.asarray([10.0, 20.0, huge])
    found = dqn.double_q_target(
        jnp.asarray(1.0), jnp.asarray(0.9), online, target, jnp.asarray(NOT_LAST)
    )
    assert found == pytest.approx(1 + 0.9 * 10)


def test_a_target_that_is_not_masked_takes_the_best_of_all_actions():
    values = jnp.asarray([[0.0, 0.0, 0.0], [3.0, 2.0, 5.0]])
    items = batch([0], [0], [1.0], [0.9], [1], [NOT_LAST])
    for masked, best in ((True, 3.0), (False, 5.0)):
        config = dataclasses.replace(CONFIG, masked_target=masked)
        _, _, errors = update(learner(values, values, config), items, config=config)
        assert errors[0] == pytest.approx(0.0 - (1 + 0.9 * best))


def test_an_update_learns_from_the_least_threatening_action_where_nothing_is_secure():
    threat = jnp.asarray([[0.5, 0.2, 0.3]])
    mask = jax.vmap(shield.shield, (0, None))(threat, 0.01).admissible
    values = jnp.asarray([[0.0, 0.0, 0.0], [50.0, 2.0, 90.0]])
    items = batch([0], [0], [1.0], [0.9], [1], mask)
    _, _, errors = update(learner(values, values), items)
    assert errors[0] == pytest.approx(0.0 - (1 + 0.9 * 2.0))


def test_errors_and_loss_by_hand():
    params = jnp.asarray([[0.0, 1.0, 2.0], [3.0, 2.0, 99.0]])
    target = jnp.asarray([[0.0, 0.0, 0.0], [4.0, 7.0, 99.0]])
    items = batch(
        [0, 0, 1], [1, 2, 0], [1.0, 2.0, -5.0], [0.9, 0.81, 0.0], [1, 0, 1], [NOT_LAST] * 3
    )
    config = dataclasses.replace(CONFIG, reward_scale=0.5)
    weights = jnp.asarray([1.0, 0.5, 0.25])
    goals = np.asarray([0.5 + 0.9 * 4, 1.0 + 0.81 * 0, -2.5])
    by_hand = np.asarray([1.0, 2.0, 3.0]) - goals
    huber = np.where(np.abs(by_hand) <= 1, by_hand**2 / 2, np.abs(by_hand) - 0.5)
    _, loss, errors = update(learner(params, target), items, weights, config)
    np.testing.assert_allclose(errors, by_hand, rtol=1e-5)
    assert loss == pytest.approx((np.asarray(weights) * huber).mean(), rel=1e-5)


def test_a_gradient_step_brings_values_nearer_to_their_targets():
    params = jnp.zeros((2, 3))
    items = batch([0, 1], [1, 2], [1.0, -1.0], [0.0, 0.0], [0, 0], [ALL] * 2)
    before = learner(params, params)
    after, first, errors = update(before, items)
    _, second, fewer = update(after, items)
    assert (jnp.abs(fewer) < jnp.abs(errors)).all()
    assert second < first
    # Adam's first step is the learning rate, and only the taken actions move.
    expected = [[0, 0.01, 0], [0, 0, -0.01]]
    np.testing.assert_allclose(after.params, expected, rtol=1e-4, atol=1e-9)
    assert after.updates == 1


def test_weights_of_zero_teach_nothing():
    items = batch([0, 1], [1, 2], [1.0, -1.0], [0.0, 0.0], [0, 0], [ALL] * 2)
    before = learner(jnp.zeros((2, 3)), jnp.zeros((2, 3)))
    after, _, _ = update(before, items, jnp.asarray([1.0, 0.0]))
    assert after.params[0, 1] > 0
    assert (after.params[1] == 0).all()


def test_targets_are_no_part_of_the_gradient():
    # State 1 is only ever reached: its values serve as targets and must not move.
    items = batch([0], [0], [1.0], [0.9], [1], [ALL])
    params = jnp.ones((2, 3))
    after, _, _ = update(learner(params, params), items)
    np.testing.assert_array_equal(after.params[1], params[1])
    assert (after.params[0] != params[0]).any()


def test_the_target_network_follows_slowly():
    params, target = jnp.full((2, 3), 5.0), jnp.full((2, 3), 1.0)
    items = batch([0], [0], [0.0], [0.0], [1], [ALL])
    after, _, _ = update(learner(params, target), items)
    np.testing.assert_allclose(after.target, 0.9 * target + 0.1 * after.params, rtol=1e-6)


def test_the_target_network_is_copied_every_period():
    config = dataclasses.replace(CONFIG, polyak=0.0, period=3)
    items = batch([0], [0], [9.0], [0.0], [1], [ALL])
    state = learner(jnp.zeros((2, 3)), jnp.full((2, 3), -1.0), config)
    copied = []
    for _ in range(7):
        old = state.target
        state, _, _ = update(state, items, config=config)
        copied.append(bool((state.target == state.params).all()))
        assert copied[-1] or (state.target == old).all()
    assert copied == [False, False, True, False, False, True, False]


@pytest.mark.parametrize("anneal", [True, False])
def test_the_rate_falls_to_a_tenth_if_annealed(anneal):
    config = dataclasses.replace(CONFIG, anneal=anneal)
    transform = dqn.optimiser(config, UPDATES)
    state = transform.init(jnp.zeros(1))
    sizes = []
    for _ in range(15):
        change, state = transform.update(jnp.ones(1), state)
        sizes.append(-float(change[0]) / config.learning_rate)
    half = 0.5 * (1 + np.cos(np.pi * np.minimum(np.arange(15), 10) / 10))
    np.testing.assert_allclose(sizes, 0.1 + 0.9 * half if anneal else np.ones(15), rtol=1e-3)


def test_repeated_updates_solve_a_chain():
    # 0 -> 1 -> end with reward 1; the last action of 1 pays 100 and is inadmissible.
    items = batch(
        [0, 1, 1], [0, 0, 2], [0.0, 1.0, 100.0], [0.9, 0.0, 0.0], [1, 1, 1], [NOT_LAST] * 3
    )
    config = dataclasses.replace(CONFIG, learning_rate=0.1, polyak=0.3)
    params = jnp.zeros((2, 3))
    state = learner(params, params, config)
    for _ in range(300):
        state, _, _ = update(state, items, config=config)
    assert state.params[1, 0] == pytest.approx(1.0, abs=0.02)
    assert state.params[0, 0] == pytest.approx(0.9, abs=0.02)


def test_a_fresh_learner_s_target_is_a_copy():
    class Net:
        @staticmethod
        def init(key, encoded):
            return jax.random.normal(key, (2, 3))

    state = dqn.init(jax.random.key(0), Net, dqn.optimiser(CONFIG, UPDATES), named(0))
    np.testing.assert_array_equal(state.params, state.target)
    assert state.params is not state.target  # both are donated
    assert state.updates == 0


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("gamma", -0.1),
        ("gamma", 1.1),
        ("gamma", float("nan")),
        ("learning_rate", 0.0),
        ("epsilon", 0.0),
        ("polyak", 1.5),
        ("period", 0),
        ("period", 2.5),
        ("reward_scale", 0.0),
        ("reward_scale", float("inf")),
    ],
)
def test_bad_settings_are_named(field, value):
    with pytest.raises(ValueError, match=rf"^planning\.learner\.{field} is .*must"):
        dataclasses.replace(CONFIG, **{field: value}).validate("planning.learner")
