import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import S, U, counterexample_1, jitted, random_cmdp, random_policy

from rp_jax.tabular import exact, secure, thresholds
from rp_jax.tabular.secure import Shield


@pytest.mark.parametrize("horizon", [1, 2, 7, 100])
@pytest.mark.parametrize("beta", [0.0, 1e-300, 0.3, 0.999, 1 - 1e-6, 1 - 1e-12, 1 - 2**-53, 1.0])
def test_the_effective_horizon_is_exact_however_close_to_1(beta, horizon):
    exact = sum(Fraction(beta) ** k for k in range(horizon))
    found = float(thresholds.effective_horizon(beta, horizon))
    assert found == pytest.approx(float(exact), rel=1e-14)


def test_the_effective_horizon_without_end():
    assert float(thresholds.effective_horizon(0.75, None)) == 4.0


def test_thresholds_by_hand():
    cmdp, eta = counterexample_1()
    # Danger of eta: .01, then what u costs within two steps by a2: nothing.
    assert thresholds.corollary_1(cmdp, eta, 0.07) == pytest.approx(0.06 / 3)
    assert thresholds.corollary_1(cmdp, eta, 0.07, thresholds.PAPER) == pytest.approx(0.01)
    # greedy-eta plays b: no danger.
    assert thresholds.corollary_2(cmdp, eta, 0.06) == pytest.approx(0.02)
    assert thresholds.corollary_2(cmdp, eta, 0.06, thresholds.PAPER) == pytest.approx(0.01)


def test_an_unsafe_baseline_policy_is_an_error():
    cmdp, eta = counterexample_1()
    chosen, _ = thresholds.reconnoitre_and_plan(cmdp, 0.0, eta)
    assert float(chosen.x) == 0
    from_u = cmdp.replace(start=jnp.eye(5)[U])
    for rule in thresholds.RULES.values():
        with pytest.raises(ValueError, match=r"c is 0\.5; it must be at least 1, .* is not safe"):
            thresholds.reconnoitre_and_plan(from_u, 0.5, eta, rule)
    for c in (-1.0, float("nan")):
        with pytest.raises(ValueError, match=r"c is .*; it must be"):
            thresholds.reconnoitre_and_plan(cmdp, c, eta)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (np.full((5, 2), 0.6), r"policy\[0\] sums to 1.2"),
        (np.full((5, 2), np.nan), "policy has a value that is not finite"),
        (np.ones(2) / 2, r"policy has shape \(2,\); it must be \(5, 2\) or \(3, 5, 2\)"),
        (np.asarray([[2.0, -1.0]] * 5), "policy has the probability -1.0"),
        ("policy", "policy is no array of numbers"),
    ],
)
def test_what_is_no_policy_is_an_error(policy, message):
    cmdp, _ = counterexample_1()
    with pytest.raises(ValueError, match=message):
        thresholds.reconnoitre_and_plan(cmdp, 1.0, policy)


@jax.jit
def worst_danger(cmdp, admissible):
    return exact.expected(cmdp, secure.worst(cmdp, admissible))


def danger_of(cmdp, allowed):
    return float(worst_danger(cmdp, allowed.admissible))


threaten = jitted(exact.threat)
plan_in = jitted(thresholds.planned, static=(3,))
least = jitted(exact.least_threat)
intersect = jitted(secure.secure_at_all_times)
largest_x = jitted(thresholds.evaluated)


def test_threats_of_the_first_step_for_all_steps_are_unsafe_and_ours_are_not():
    cmdp, eta = counterexample_1()
    action = threaten(cmdp, eta).action
    x = 0.01
    np.testing.assert_allclose(action[0, S], [0.01, 0])
    np.testing.assert_allclose(action[0, U], [1, 1.0001])
    np.testing.assert_allclose(action[1, U], [1, 0])
    each = secure.secure(action, x)
    np.testing.assert_array_equal(each.admissible[1, U], [False, True])
    assert danger_of(cmdp, each) == pytest.approx(0.01)
    always = secure.secure_at_all_times(action, x)
    assert not always.secure[:, U].any()
    np.testing.assert_array_equal(always.admissible[1, U], [False, True])  # greedy of that step
    assert danger_of(cmdp, always) == pytest.approx(0.01)
    first = secure.secure(jnp.broadcast_to(action[:1], action.shape), x)
    np.testing.assert_array_equal(first.admissible[1, U], [True, False])
    assert danger_of(cmdp, first) == pytest.approx(1.01)


def test_x_may_differ_by_step():
    cmdp = random_cmdp(0, horizon=3)
    action = threaten(cmdp, exact.uniform(cmdp)).action
    x = jnp.asarray([0.0, jnp.inf, float(jnp.median(action[2]))])
    found = secure.secure(action, x)
    for t in range(3):
        expected = secure.secure(action[t : t + 1], x[t])
        np.testing.assert_array_equal(found.admissible[t], expected.admissible[0])
        np.testing.assert_array_equal(found.secure[t], expected.secure[0])
    assert found.admissible[1].all()


def test_a_threat_equal_to_x_is_admitted():
    cmdp = random_cmdp(1)
    action = threaten(cmdp, exact.uniform(cmdp)).action
    for x in np.unique(np.asarray(action)):
        admitted = secure.secure(action, x)
        np.testing.assert_array_equal(
            admitted.admissible & admitted.secure[..., None], np.asarray(action) <= x
        )


def test_the_worst_policy_is_the_worst_of_all():
    cmdp = random_cmdp(2, states=3, actions=2, horizon=3)
    allowed = secure.secure(threaten(cmdp, exact.uniform(cmdp)).action, 0.6).admissible
    worst = secure.worst(cmdp, allowed)
    assert (worst.policy <= allowed).all()
    evaluated = threaten(cmdp, worst.policy)
    np.testing.assert_allclose(evaluated.state, worst.state, atol=1e-12)
    evaluate = jitted(exact.threat)
    for seed in range(200):
        weights = jnp.asarray(random_policy(seed, cmdp.shape)) * allowed
        policy = weights / weights.sum(-1, keepdims=True)
        assert (evaluate(cmdp, policy).state <= worst.state + 1e-12).all()


def test_a_plan_stays_inside_and_is_the_best_there():
    cmdp = random_cmdp(3, states=3, actions=3, horizon=3)
    allowed = secure.secure(threaten(cmdp, exact.uniform(cmdp)).action, 0.5).admissible
    best = secure.plan(cmdp, allowed)
    assert (best.policy <= allowed).all()
    evaluate = jitted(exact.returns)
    np.testing.assert_allclose(evaluate(cmdp, best.policy).state, best.state, atol=1e-12)
    for seed in range(200):
        weights = jnp.asarray(random_policy(seed, cmdp.shape)) * allowed
        policy = weights / weights.sum(-1, keepdims=True)
        assert (evaluate(cmdp, policy).state <= best.state + 1e-12).all()


def test_value_iteration_of_the_p_mdp_by_hand():
    """Algorithm 3 as printed, swept until it stands still."""
    cmdp = random_cmdp(4, horizon=None, gamma=0.8, beta=0.8)
    found = exact.threat(cmdp, exact.uniform(cmdp)).action
    allowed = secure.secure(found, float(np.median(found.min(-1))))
    assert 0 < int(allowed.secure.sum()) < allowed.secure.size
    value = np.zeros(4)
    for _ in range(400):
        q = np.asarray(cmdp.reward) + 0.8 * np.asarray(cmdp.transition) @ value
        for s in range(4):
            if allowed.secure[0, s]:
                value[s] = q[s, np.asarray(allowed.admissible[0, s])].max()
            else:
                value[s] = q[s, np.argmin(found[0, s])]
    np.testing.assert_allclose(secure.plan(cmdp, allowed.admissible).state[0], value, atol=1e-12)


def test_the_evaluated_threshold_is_the_largest():
    for seed in range(5):
        cmdp = random_cmdp(seed)
        action = threaten(cmdp, exact.uniform(cmdp)).action
        values = np.unique(np.asarray(action))
        dangers = [danger_of(cmdp, secure.secure(action, x)) for x in values]
        assert (np.diff(dangers) >= -1e-12).all()
        for c in (dangers[0], np.mean(dangers), dangers[-1], 100.0):
            largest = max(x for x, danger in zip(values, dangers, strict=True) if danger <= c)
            assert float(largest_x(cmdp, action, c)) == largest


def test_the_evaluated_threshold_says_when_there_is_none():
    cmdp, eta = counterexample_1()
    cmdp = cmdp.replace(start=jnp.eye(5)[U])
    action = threaten(cmdp, eta).action
    assert math.isnan(thresholds.evaluated(cmdp, action, 0.5))
    # Always greedy is safe at c = 1, yet any x admits the free a2 at t = 1 and no more.
    assert float(thresholds.evaluated(cmdp, action, 1.0)) == pytest.approx(1.0)


NESTED = ("per step", "evaluated", "advantage")  # the intersections of equation 5 are not


@pytest.mark.parametrize("rule", thresholds.RULES)
def test_each_rule_keeps_the_bound_and_more_room_earns_no_less(rule):
    for seed in range(3):
        cmdp = random_cmdp(seed, horizon=5)
        star = least(cmdp)
        lowest = float(exact.expected(cmdp, star))
        earned = []
        for c in (lowest, lowest + 0.1, lowest + 1.0, 100.0):
            chosen, planned = plan_in(cmdp, c, star.policy, thresholds.RULES[rule])
            assert danger_of(cmdp, chosen.shield) <= c + 1e-12
            earned.append(float(exact.expected(cmdp, planned)))
        assert rule not in NESTED or (np.diff(earned) >= -1e-12).all()
        free = exact.expected(cmdp, secure.plan(cmdp, jnp.ones(cmdp.shape, bool)))
        assert earned[-1] == pytest.approx(float(free))


def test_rules_from_the_strictest_to_the_freest():
    gains = []
    for seed in range(20):
        cmdp = random_cmdp(seed, horizon=5)
        star = least(cmdp)
        c = float(exact.expected(cmdp, star)) + 0.3
        found = {}
        for name in ("paper", "tight", "per step", "evaluated"):
            rule = thresholds.RULES[name]
            chosen, planned = plan_in(cmdp, c, star.policy, rule)
            found[name] = float(exact.expected(cmdp, planned)), chosen
        earned = [found[name][0] for name in ("tight", "per step", "evaluated")]
        assert (np.diff(earned) >= -1e-12).all()
        assert float(found["tight"][1].x) == pytest.approx(2 * float(found["paper"][1].x))
        gains.append(earned[-1] - earned[0])
    assert max(gains) > 0.1


def test_factor_1_cannot_be_beaten():
    """One step, a safe action and one of threat x: the bound is met with equality."""
    from rp_jax.tabular import cmdp as make

    one = make.make(
        np.ones((1, 2, 1)), [[0.0, 1.0]], [[0.0, 0.5]], 0, gamma=1.0, beta=1.0, horizon=1
    )
    eta = jnp.asarray([[1.0, 0.0]])
    chosen = thresholds.tight(one, eta, 0.5)
    assert float(chosen.x) == 0.5
    assert danger_of(one, chosen.shield) == 0.5
    assert not thresholds.paper(one, eta, 0.5).shield.admissible[0, 0, 1]


def test_a_certificate_needs_no_policy():
    """U with margin: m bounds the danger of the greedy policy, whatever U came from."""
    cmdp = random_cmdp(5, horizon=4)
    upper = threaten(cmdp, exact.uniform(cmdp)).action + 0.05
    proved = thresholds.certificate(cmdp, upper, 0.0)
    assert (proved.excess <= 1e-12).all()
    greedy = threaten(cmdp, exact.greedy(upper)).state
    assert (greedy <= proved.least + 1e-12).all()
    np.testing.assert_allclose(proved.state, proved.least, atol=1e-12)
    c = 3.0
    x = float(thresholds.certified(cmdp, upper, c))
    by_hand = (c - float(cmdp.start @ proved.least[0])) / sum(0.95**k for k in range(4))
    assert x == pytest.approx(by_hand)
    worst = danger_of(cmdp, secure.secure(upper, x))
    assert worst <= float(cmdp.start @ thresholds.certificate(cmdp, upper, x).state[0]) <= c


def test_a_certificate_s_bound_is_reached():
    """One step: the least U is .5, and the worst policy does x = 1."""
    from rp_jax.tabular import cmdp as make

    danger = [[0.5, 1.0]]
    one = make.make(np.ones((1, 2, 1)), [[0, 0]], danger, 0, gamma=1.0, beta=1.0, horizon=1)
    upper = jnp.asarray([danger])
    proved = thresholds.certificate(one, upper, 1.0)
    assert float(proved.least[0, 0]) == 0.5
    assert float(proved.state[0, 0]) == danger_of(one, secure.secure(upper, 1.0)) == 1.0


def test_sets_of_equation_5_are_not_nested():
    """A greater x may leave the worst policy less to do: the fallback is not in the first sets."""
    falls = 0
    for seed in range(60):
        cmdp = random_cmdp(seed, horizon=3)
        policy = jnp.asarray(random_policy(seed, cmdp.shape))
        action = threaten(cmdp, policy).action
        values = np.unique(np.asarray(action))
        dangers = [danger_of(cmdp, intersect(action, x)) for x in values]
        falls += (np.diff(dangers) < -1e-9).any()
    assert falls > 0


def test_a_shield_is_returned():
    assert isinstance(secure.secure(jnp.zeros((1, 2, 2)), 0.0), Shield)
