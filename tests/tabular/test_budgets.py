import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import S, U, counterexample_1, counterexample_2, jitted, random_cmdp, random_policy
from hypothesis import given
from hypothesis import strategies as st
from quick import compile_soon  # noqa: F401

from rp_jax.tabular import budgets, exact, oracle, secure

threaten = jitted(exact.threat)
accounted = jitted(budgets.accounted)
levels_of = jitted(budgets.in_levels, static=(2,))


worst_of = jitted(budgets.worst)
plan = jitted(budgets.plan)
threat_of = jitted(budgets.threat)


def of_start(cmdp, rule, values):
    return float(budgets.at_start(cmdp, rule, values))


def in_worst_case(cmdp, rule):
    return of_start(cmdp, rule, worst_of(cmdp, rule))


def test_costs_by_hand():
    cmdp, eta = counterexample_1()
    found = budgets.costs(cmdp, exact.threat(cmdp, eta).action)
    np.testing.assert_allclose(found.excess[0, S], [0.01, 0])
    np.testing.assert_allclose(found.excess[1, U], [1, 0])
    assert found.least[0, S] == 0
    assert (found.error == 0).all()
    halved = budgets.costs(cmdp.replace(beta=0.5), exact.threat(cmdp, eta).action)
    np.testing.assert_allclose(halved.excess[1, U], [0.5, 0])  # as seen from the start
    loose = budgets.costs(cmdp, exact.threat(cmdp, eta).action + 0.1)
    np.testing.assert_allclose(loose.excess[0, S], [0.01, 0], atol=1e-15)
    np.testing.assert_allclose(loose.cost[0, S], [0.01, 0], atol=1e-15)  # both m are .1 higher
    np.testing.assert_allclose(loose.cost[2, S], [-0.09, -0.1])  # m_3 is 0: what was too much


def test_a_budget_that_is_spent_is_not_spent_again():
    """After a at s, of c = 1 only .99 is left at u: a1, which costs 1, is not allowed any more."""
    cmdp, eta = counterexample_1()
    upper = exact.threat(cmdp, eta).action
    for refund in (False, True):
        for c, danger in ((0.009, 0.0), (0.01, 0.01), (1.0, 0.01), (1.02, 1.01)):
            rule = budgets.budget_rule(cmdp, upper, c, refund=refund, levels=2001)
            assert in_worst_case(cmdp, rule) == pytest.approx(danger, abs=1e-12)


def test_the_least_danger_of_time_indexed_policies_may_be_promised():
    cmdp = counterexample_2()
    upper = exact.least_threat(cmdp).action
    for c, danger in ((0.4, 0.4), (0.8, 0.8), (1.0, 1.0)):
        rule, _ = budgets.plan_with_budget(cmdp, c, upper, levels=101)
        assert in_worst_case(cmdp, rule) == pytest.approx(danger)


@pytest.mark.parametrize("beta", [0.0, 0.7, 1.0])
def test_danger_is_accounted_for_by_any_function(beta):
    for seed in range(10):
        cmdp = random_cmdp(seed, beta=beta)
        policy = jnp.asarray(random_policy(seed, cmdp.shape))
        anything = np.random.default_rng(seed).normal(size=cmdp.shape[:2])
        danger = float(exact.expected(cmdp, threaten(cmdp, policy)))
        assert accounted(cmdp, jnp.asarray(anything), policy) == pytest.approx(danger, abs=1e-12)


def test_some_action_is_allowed_whatever_the_budget():
    excess = jnp.asarray([0.3, 0.0, 0.1])
    for budget, expected in (
        (0.3, [1, 1, 1]),
        (np.nextafter(0.3, 0), [0, 1, 1]),
        (0.0, [0, 1, 0]),
        (-1.0, [0, 1, 0]),
        (np.nan, [0, 1, 0]),
        (np.inf, [1, 1, 1]),
    ):
        np.testing.assert_array_equal(budgets.budget_actions(excess, jnp.asarray(budget)), expected)


def test_what_is_paid_beyond_the_budget_is_forgiven():
    for cost, left in ((0.2, 0.3), (-0.2, 0.7), (0.6, 0.0)):
        assert budgets.spend(jnp.asarray(0.5), jnp.asarray(cost)) == pytest.approx(left)


@given(st.floats(-1, 1, allow_subnormal=False), st.floats(1e-4, 1))
def test_costs_are_rounded_up_to_whole_levels_and_refunds_down(danger, size):
    count = int(levels_of(danger, size, 100_000))
    assert count * size >= danger
    assert (count - 1) * size < danger
    assert int(levels_of(0.0, size, 100_000)) == 0


def test_levels_are_bounded():
    found = budgets.in_levels(jnp.asarray([1e300, -1e300, jnp.inf]), jnp.asarray(0.1), 7)
    np.testing.assert_array_equal(found, [7, -7, 7])


def test_the_first_budget_is_rounded_down():
    cmdp = random_cmdp(0, horizon=3)
    upper = threaten(cmdp, exact.uniform(cmdp)).action
    least = float(cmdp.start @ upper.min(-1)[0])
    for refund, c in itertools.product((False, True), (least, least + 0.01, least + 0.3)):
        rule = budgets.budget_rule(cmdp, upper, c, refund=refund, levels=11)
        held = float(rule.start * rule.size)
        assert held <= c - least < held + float(rule.size) * 1.001


def by_recursion(cmdp, found, cost, budget):
    """The best return, by trying all policies of the exact budget."""
    kernel, reward = np.asarray(cmdp.transition), np.asarray(cmdp.reward)
    excess, cost = np.asarray(found.excess), np.asarray(cost)

    def best(t, s, budget):
        if t == cmdp.horizon:
            return 0.0
        options = []
        for a in np.flatnonzero(excess[t, s] <= budget):
            ahead = [
                chance * best(t + 1, z, max(budget - cost[t, s, a], 0))
                for z, chance in enumerate(kernel[s, a])
                if chance > 0
            ]
            options.append(reward[s, a] + float(cmdp.gamma) * sum(ahead))
        return max(options)

    return sum(float(chance) * best(0, s, budget) for s, chance in enumerate(cmdp.start))


@pytest.mark.parametrize("refund", [False, True])
def test_the_plan_is_the_best_of_exact_budgets_but_for_rounding(refund):
    for seed in range(3):
        cmdp = random_cmdp(seed, states=3, actions=2, horizon=4)
        upper = threaten(cmdp, exact.uniform(cmdp)).action
        found = budgets.costs(cmdp, upper)
        least = float(cmdp.start @ found.least[0])
        c = least + 0.2
        exactly = by_recursion(cmdp, found, found.cost if refund else found.excess, 0.2)
        values = []
        for levels in (6, 101, 10_001):
            rule = budgets.budget_rule(cmdp, upper, c, refund=refund, levels=levels)
            planned = plan(cmdp, rule)
            values.append(of_start(cmdp, rule, planned))
            danger = of_start(cmdp, rule, threat_of(cmdp, rule, planned.policy))
            assert danger <= in_worst_case(cmdp, rule) + 1e-12 <= c + 2e-12
        assert values[0] <= values[1] + 1e-12 <= values[2] + 2e-12 <= exactly + 3e-12
        assert values[2] == pytest.approx(exactly, abs=2e-3)
        assert exactly <= oracle.optimum(cmdp, c).value + 1e-8


def test_refunds_give_back_what_a_poor_baseline_policy_overstates():
    cmdp = random_cmdp(1, states=5, horizon=6)
    upper = threaten(cmdp, exact.uniform(cmdp)).action
    c = float(cmdp.start @ upper.min(-1)[0]) + 0.05
    values = []
    for refund in (False, True):
        rule, planned = budgets.plan_with_budget(cmdp, c, upper, refund=refund)
        values.append(of_start(cmdp, rule, planned))
        assert in_worst_case(cmdp, rule) <= c + 1e-12
    inside = exact.expected(cmdp, secure.plan(cmdp, secure.secure(upper, 0.0).admissible))
    assert inside < values[0] < values[1] - 0.05


def test_without_slack_there_is_nothing_to_refund():
    """U of eta* is its own backup."""
    cmdp = random_cmdp(2)
    found = budgets.costs(cmdp, exact.least_threat(cmdp).action)
    np.testing.assert_allclose(found.excess, found.cost, atol=1e-15)


def test_a_budget_that_covers_everything_is_no_constraint():
    cmdp = random_cmdp(3)
    upper = threaten(cmdp, exact.uniform(cmdp)).action
    rule, planned = budgets.plan_with_budget(cmdp, 50.0, upper, levels=1001)
    best = exact.expected(cmdp, secure.plan(cmdp, np.ones(cmdp.shape, bool)))
    assert of_start(cmdp, rule, planned) == pytest.approx(float(best))
    assert planned.policy.shape == (4, 4, 1001, 3)
    np.testing.assert_array_equal(planned.policy.sum(-1), 1)


def sampled_danger(fresh):
    """Danger and expected overspend where V is a mean of one outcome of each of two actions.

    Step 0: both actions have danger 1 with probability .5; m_0 = .5, c = .5. The action is the one
    whose drawn danger is less, as a look-ahead would take it. Step 1: one action is free, the other
    has danger .5, and is taken where the budget allows it. V is that drawn danger, or, fresh, a new
    outcome of the action taken.
    """
    danger = overspent = 0.0
    for draws in itertools.product((0.0, 1.0), repeat=3):
        charged = (draws[2] if fresh else min(draws[:2])) - 0.5
        left = budgets.spend(jnp.asarray(0.0), jnp.asarray(charged))
        takes = budgets.budget_actions(jnp.asarray([0.0, 0.5]), left)[1]
        danger += (0.5 + 0.5 * float(takes)) / 8
        overspent += max(charged, 0.0) / 8
    return danger, overspent


def test_outcomes_that_chose_the_action_may_not_be_its_refund():
    danger, overspent = sampled_danger(fresh=True)
    assert danger == 0.5 + overspent == 0.75
    danger, overspent = sampled_danger(fresh=False)
    assert danger == 0.875 > 0.5 + overspent == 0.625


GOOD = {"c": 2.0, "refund": True, "levels": 11}


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("c", -0.1, r"c is -0\.1; it must be a finite number, at least 0"),
        ("c", float("nan"), "c is nan; it must be a finite number"),
        ("c", 0.3, r"c is 0\.3; it must be at least 0\.4, the least danger of any policy"),
        ("c", 0.5, r"c is 0\.5; it must be at least 1, the danger that upper leaves at the start"),
        ("levels", 1, "levels is 1; it must be an integer, at least 2"),
        ("upper", np.ones((2, 2)), r"upper has shape \(2, 2\); it must be \(2, 2, 2\)"),
        ("upper", -np.ones((2, 2, 2)), r"upper has the value -1\.0; it must be at least 0"),
        ("upper", np.full((2, 2, 2), np.nan), "upper has a value that is not finite"),
    ],
)
def test_what_is_wrong_is_named(field, value, message):
    upper = np.ones((2, 2, 2))
    with pytest.raises(ValueError, match=message):
        budgets.plan_with_budget(counterexample_2(), **{"upper": upper, **GOOD, field: value})


def test_budgets_are_of_a_finite_horizon():
    endless = random_cmdp(0, horizon=None)
    with pytest.raises(ValueError, match="horizon is None; it must be a number of steps"):
        budgets.plan_with_budget(endless, upper=np.ones(endless.shape), **GOOD)


def test_budgets_are_planned_side_by_side():
    cmdp = random_cmdp(4)
    upper = threaten(cmdp, exact.uniform(cmdp)).action

    def value(c):
        rule = budgets.budget_rule(cmdp, upper, c, refund=True, levels=21)
        return budgets.at_start(cmdp, rule, budgets.plan(cmdp, rule))

    bounds = jnp.asarray([1.5, 2.0])
    together = jax.jit(jax.vmap(value))(bounds)
    np.testing.assert_allclose(together, [value(c) for c in bounds])
