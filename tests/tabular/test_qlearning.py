import functools

import jax
import numpy as np
import pytest
from cases import random_cmdp

from rp_jax.tabular import budgets, exact, qlearning, secure

STEPS = 150_000


@functools.cache
def learned(horizon, seeds=3):
    cmdp = random_cmdp(0, states=3, actions=3, horizon=horizon, gamma=0.6, beta=0.6)
    cmdp = cmdp.replace(reward=cmdp.reward - 2)  # so that what is never tried looks best
    found = exact.threat(cmdp, exact.uniform(cmdp)).action
    allowed = secure.secure(found, float(np.quantile(found, 0.45)))
    learn = jax.vmap(qlearning.learn, in_axes=(0, None, None, None))
    keys = jax.random.split(jax.random.key(1), seeds)
    states = jax.jit(learn, static_argnums=3)(keys, cmdp, allowed.admissible, STEPS)
    return cmdp, allowed, states


@pytest.mark.parametrize("horizon", [None, 3])
def test_q_learning_arrives_where_value_iteration_does(horizon):
    cmdp, allowed, states = learned(horizon)
    assert 0 < int(allowed.secure.sum()) < allowed.secure.size
    expected = np.asarray(secure.plan(cmdp, allowed.admissible).action)
    for values in np.asarray(states.values):
        np.testing.assert_allclose(
            values[np.asarray(allowed.admissible)],
            expected[np.asarray(allowed.admissible)],
            atol=0.06,
        )


@pytest.mark.parametrize("horizon", [None, 3])
def test_nothing_inadmissible_is_ever_tried(horizon):
    _, allowed, states = learned(horizon)
    tried = np.asarray(states.visits)
    outside = ~np.asarray(allowed.admissible)
    assert outside.any()
    assert (tried[:, outside] == 0).all()
    assert (tried[:, ~outside] > 1000).all()
    assert (tried.sum(axis=(1, 2, 3)) == STEPS).all()
    assert not np.array_equal(tried[0], tried[1])


def test_settings_out_of_range_are_named():
    cmdp = random_cmdp(0)
    mask = np.ones(cmdp.shape, bool)
    with pytest.raises(ValueError, match="steps is 0; it must be"):
        qlearning.learn(jax.random.key(0), cmdp, mask, 0)
    with pytest.raises(ValueError, match=r"omega is 0\.5; it must be"):
        qlearning.learn(jax.random.key(0), cmdp, mask, 10, omega=0.5)


@functools.cache
def learned_with_budget(seeds=2):
    cmdp = random_cmdp(0, states=3, actions=3, horizon=2, gamma=0.6, beta=0.6)
    cmdp = cmdp.replace(reward=cmdp.reward - 2)
    upper = exact.threat(cmdp, exact.uniform(cmdp)).action
    c = float(cmdp.start @ upper.min(axis=-1)[0]) + 0.3
    rule = budgets.budget_rule(cmdp, upper, c, refund=True, levels=4)
    learn = jax.vmap(qlearning.learn_with_budget, in_axes=(0, None, None, None))
    keys = jax.random.split(jax.random.key(2), seeds)
    return cmdp, rule, jax.jit(learn, static_argnums=3)(keys, cmdp, rule, 2 * STEPS)


def allowed_by(rule):
    """The actions that each step, state and budget allows, (H, S, B, A)."""
    return np.asarray(jax.vmap(budgets.allowed, in_axes=(0, None))(rule.excess, rule))


def test_q_learning_with_budgets_arrives_where_planning_does():
    cmdp, rule, states = learned_with_budget()
    expected = np.asarray(budgets.plan(cmdp, rule).action)
    allowed = allowed_by(rule)
    assert 0.2 < allowed.mean() < 0.9
    for values in np.asarray(states.values):
        np.testing.assert_allclose(values[allowed], expected[allowed], atol=0.08)


def test_nothing_beyond_a_budget_is_ever_tried():
    _, rule, states = learned_with_budget()
    tried = np.asarray(states.visits)
    allowed = allowed_by(rule)
    assert (tried[:, ~allowed] == 0).all()
    assert (tried[:, allowed] > 500).all()
    assert (tried.reshape(2, -1).sum(-1) == 2 * STEPS).all()
    _, first = qlearning.init(random_cmdp(0), rule)
    assert first.shape == (4, 4, 4, 3)
