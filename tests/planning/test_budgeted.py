"""Budgets of danger, on a corridor with a pit (`probe`) whose numbers are known."""

import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest

from rp_jax import evaluation
from rp_jax.planning import budgeted
from rp_jax.planning.budgeted import BudgetState, granted, unwrapped, with_budget

STAY, LEFT, RIGHT = probe.STAY, probe.LEFT, probe.RIGHT
SLIP = 0.1  # the step to the right into the pit is made with probability .9


def world(low, high, **options):
    """The probe's P-MDP with a budget of danger."""
    params = probe.make_params(**{"slip": SLIP, **options})
    pmdp = probe.make_pmdp(probe, params, x=np.inf)
    pmdp = pmdp.replace(threats={"pit": probe.threat_model(pmdp.params)}, shielded=True)
    env, params = with_budget(pmdp.env, pmdp.params, low, high)
    return pmdp.replace(env=env, params=params)


def at(cells, promised, budget=None):
    """States of the corridor; those with a budget are in the middle of an episode."""
    states = jax.vmap(probe.start_at)(jnp.asarray(cells, float))
    found = jax.vmap(granted, (0, None))(states, jnp.asarray(promised, float))
    if budget is None:
        return found
    left = jnp.broadcast_to(jnp.asarray(budget, float), found.budget.shape)
    return found.replace(budget=left, begun=jnp.ones_like(found.begun))


@pytest.mark.parametrize(("budget", "admitted"), [(0.5, 2), (1.1, 3)])
def test_what_costs_more_than_the_budget_is_forbidden(budget, admitted):
    """One step beside the pit the way into it costs 1 more than the others; in it all is lost."""
    pmdp = world(0.5, 0.5)
    seen = jax.jit(pmdp.perceive)(at([5, 6, 2], 2.0, budget))
    np.testing.assert_array_equal(seen.admissible.sum(axis=1), [admitted, 3, 3])
    np.testing.assert_allclose(seen.threshold, [budget, 1 + budget, budget], atol=1e-6)
    assert seen.secure.all()


def test_at_the_start_the_least_danger_is_taken_off_the_promise():
    pmdp = world(0.25, 0.25)
    seen = jax.jit(pmdp.perceive)(at([5, 6], 0.25))
    np.testing.assert_allclose(seen.threshold, [0.25, 0.25], atol=1e-6)
    np.testing.assert_array_equal(seen.secure, [True, False])  # in the pit more than .25 is certain
    np.testing.assert_array_equal(seen.admissible[1], [True, False, False])


def test_a_cap_on_single_steps_holds_beside_the_budget():
    pmdp = world(1.0, 1.0).replace(x=jnp.asarray(0.3))
    seen = jax.jit(pmdp.perceive)(at([5, 2], 1.0, 1.0))
    np.testing.assert_allclose(seen.threshold, [0.3, 0.3])
    np.testing.assert_array_equal(seen.admissible.sum(axis=1), [2, 3])


def moved(pmdp, states, actions):
    seen = jax.jit(pmdp.perceive)(states)
    keys = jax.random.split(jax.random.key(0), len(actions))
    return jax.jit(pmdp.advance)(keys, states, jnp.asarray(actions), seen)[0]


def test_without_refunds_the_threat_is_paid():
    start = at([5, 5, 3], 0.9, 0.8)
    reached = moved(world(0.9, 0.9), start, [STAY, RIGHT, RIGHT])
    np.testing.assert_allclose(reached.budget, [0.8, 0.0, 0.8], atol=1e-6)  # 1 is more than .8
    np.testing.assert_allclose(reached.booked, [0.0, 1.0, 0.0], atol=1e-6)
    assert reached.begun.all()


def test_with_refunds_the_expected_danger_is_paid():
    """The way into the pit has threat 1, but the walker slips with probability .1."""
    pmdp = world(2.0, 2.0).replace(refunds=4000)
    reached = moved(pmdp, at([5, 5], 2.0, 1.5), [STAY, RIGHT])
    np.testing.assert_allclose(reached.budget, [1.5, 1.5 - 0.9], atol=0.02)
    np.testing.assert_allclose(reached.booked, [0.0, 0.9], atol=0.02)


def test_the_first_step_books_what_was_left_from_the_start():
    """In the pit the least danger is 1 already, and an action leads to 1: 1 is booked, not 0."""
    reached = moved(world(2.0, 2.0), at([6], 2.0), [STAY])
    np.testing.assert_allclose(reached.booked, 1.0, atol=1e-6)
    np.testing.assert_allclose(reached.budget, 1.0, atol=1e-6)


def test_a_budget_never_exceeds_the_promise_and_never_falls_below_zero():
    env = budgeted.Budgeted(probe)
    state = BudgetState(probe.start_at(3), *map(jnp.asarray, (0.1, 0.05, 0.0, True)))
    settle = lambda least, danger: env.settle(state, state, *map(jnp.asarray, (least, danger)))  # noqa: E731
    assert float(settle(0.5, 0.1).budget) == pytest.approx(0.1)  # .45 is left, .1 was promised
    assert float(settle(0.0, 0.9).budget) == 0.0
    assert float(settle(0.0, 0.9).booked) == pytest.approx(0.9)  # what was forgiven is booked
    assert float(settle(0.0, 0.02).budget) == pytest.approx(0.03)


def test_the_budget_is_seen_after_all_else():
    env, params = with_budget(probe, probe.make_params(), 0.01, 1.0)
    state = granted(probe.start_at(3), jnp.asarray(0.1))
    seen = env.observe(state, params)
    np.testing.assert_array_equal(seen[:-1], probe.observe(state.inner, params.inner))
    assert seen[-1] == pytest.approx(-0.5)  # half of log10 of 0.1
    assert env.observe(state.replace(budget=jnp.zeros(())), params)[-1] == pytest.approx(-3)
    assert unwrapped(env, params) == (probe, params.inner)
    assert unwrapped(probe, params.inner) == (probe, params.inner)


@pytest.mark.parametrize("promised", [0.25, 0.45])
def test_a_reckless_policy_keeps_its_promise_and_its_account_is_unbiased(promised):
    """A step into the pit succeeds once in ten, and has a threat of .2; it is tried while it may.

    With refunds the budget pays .1 for each try.
    """
    pmdp = world(promised, promised, slip=0.9, time_limit=60).replace(refunds=16)
    pmdp = pmdp.replace(threats={"pit": twice_as_dangerous(pmdp.params.inner)})

    def head_for_the_pit(percept):
        return jnp.tile(jnp.asarray([0.0, -1.0, 1.0]), (len(percept.threat), 1))

    play = jax.jit(
        lambda key, pmdp: evaluation.run_episodes(key, pmdp, head_for_the_pit, 4000, batch=500)
    )
    with jax.numpy_rank_promotion("allow"):
        rows = jax.device_get(play(jax.random.key(3), pmdp))
    fell, booked = rows.danger.mean(), rows.booked.mean()
    error = 3 * np.sqrt(rows.danger.var() / 4000 + rows.booked.var() / 4000)
    assert fell <= promised + error
    assert abs(booked - fell) < error
    assert fell > promised / 4  # the promise is used


def twice_as_dangerous(params):
    """Threat .2 of stepping into the pit, where it is .1; the pit itself is certain."""
    model = probe.threat_model(params)
    kernel = model.params["params"]["Dense_0"]["kernel"]
    bias = jnp.asarray([20.0, 20.0, 40.0 + np.log(0.2 / 0.8)])  # to the right, one step beside it
    return model.replace(params={"params": {"Dense_0": {"kernel": kernel, "bias": bias}}})
