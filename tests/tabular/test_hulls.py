import numpy as np
import pytest
from cases import counterexample_2, random_cmdp

from rp_jax.tabular import exact, frozen_lake, hulls, oracle

DISCOUNTS = [(0.9, 0.6), (1.0, 1.0), (0.3, 1.0), (0.5, 0.0), (0.0, 0.5)]


@pytest.mark.parametrize(("gamma", "beta"), DISCOUNTS)
def test_the_optimum_is_the_linear_program_s(gamma, beta):
    for seed in range(3):
        cmdp = random_cmdp(seed, horizon=4, gamma=gamma, beta=beta)
        vertices = oracle.frontier(cmdp)
        low, high = vertices[0].danger, vertices[-1].danger
        found = hulls.hulls(cmdp, low)
        for c in (low, *np.linspace(low, high, 4)[1:], high + 1):
            assert found.best(c) == pytest.approx(oracle.mixed(vertices, c), abs=1e-8)
        c = low + 0.3 * (high - low) + 1e-6
        assert found.best(c) == pytest.approx(oracle.optimum(cmdp, c).value, abs=1e-7)


@pytest.mark.parametrize("holes", frozen_lake.HOLES)
def test_the_optimum_of_frozen_lake(holes):
    lake = frozen_lake.frozen_lake(holes=holes, horizon=20)
    found = hulls.hulls(lake, 0.0)
    vertices = oracle.frontier(lake)
    for c in (0.0, 0.01, 0.05, 0.1, 0.2, 0.5):
        assert found.best(c) == pytest.approx(oracle.mixed(vertices, c), abs=1e-9)


def test_the_curve_of_each_state_begins_at_its_least_danger_and_is_concave():
    cmdp = random_cmdp(5, horizon=4)
    found = hulls.hulls(cmdp, 5.0)
    least = np.asarray(exact.least_threat(cmdp).state)
    assert len(found.steps) == 5
    for t in range(4):
        for s, hull in enumerate(found.steps[t]):
            assert hull.danger[0] == pytest.approx(least[t, s], abs=1e-12)
            slopes = np.diff(hull.value) / np.diff(hull.danger)
            assert (slopes > 0).all()
            assert (np.diff(slopes) < 0).all()
    assert all(hull.best(3.0) == hull.best(0.0) == 0 for hull in found.steps[4])


@pytest.mark.parametrize(("gamma", "beta"), DISCOUNTS)
def test_each_promise_is_kept_by_promises_and_earns_what_it_says(gamma, beta):
    """d + beta E[p'] = p and r + gamma E[V(p')] = V(p): by induction, the policy is the optimum."""
    cmdp = random_cmdp(6, horizon=3, gamma=gamma, beta=beta)
    kernel, reward, danger = map(np.asarray, (cmdp.transition, cmdp.reward, cmdp.danger))
    found = hulls.hulls(cmdp, 5.0)
    rng = np.random.default_rng(0)
    mixed = 0
    for t, s in np.ndindex(3, 4):
        hull = found.steps[t][s]
        for promise in (*rng.uniform(hull.danger[0], hull.danger[-1], 5), *hull.danger[[0, -1]]):
            choices = found.choices(t, s, promise)
            mixed += len(choices) == 2
            assert sum(choice.probability for choice in choices) == pytest.approx(1)
            kept = earned = 0.0
            for probability, a, promises in choices:
                after = list(zip(found.steps[t + 1], promises, strict=True))
                for hull_after, p in after:
                    assert hull_after.danger[0] <= p <= hull_after.danger[-1] + 1e-12
                ahead = [hull_after.best(p) for hull_after, p in after]
                kept += probability * (danger[s, a] + beta * kernel[s, a] @ promises)
                earned += probability * (reward[s, a] + gamma * kernel[s, a] @ ahead)
            assert kept == pytest.approx(promise, abs=1e-11)
            assert earned == pytest.approx(hull.best(promise), abs=1e-9)
    assert mixed > 0


def test_the_policy_played_to_the_end_has_the_danger_that_was_promised():
    cmdp = random_cmdp(7, states=3, actions=2, horizon=3)
    least = float(exact.expected(cmdp, exact.least_threat(cmdp)))
    c = least + 0.07
    found = hulls.hulls(cmdp, c)

    def played(t, s, promise):
        if t == 3:
            return np.zeros(2)
        total = np.zeros(2)
        for probability, a, promises in found.choices(t, s, promise):
            step = np.asarray([float(cmdp.danger[s, a]), float(cmdp.reward[s, a])])
            for z, chance in enumerate(np.asarray(cmdp.transition[s, a])):
                if chance > 0:
                    discounts = np.asarray([float(cmdp.beta), float(cmdp.gamma)])
                    step += chance * discounts * played(t + 1, z, promises[z])
            total += probability * step
        return total

    start = np.asarray(cmdp.start)
    parts = [played(0, s, promise) for s, promise in enumerate(found.at_start(c))]
    danger, value = start @ np.asarray(parts)
    assert danger == pytest.approx(c, abs=1e-12)
    assert value == pytest.approx(found.best(c), abs=1e-10)
    assert value == pytest.approx(oracle.optimum(cmdp, c).value, abs=1e-7)


def test_a_promise_is_split_where_it_earns_the_most():
    """Hull 0 earns 4 per danger, then 1; hull 1 earns 2; both have least danger .1."""
    steep = hulls.Hull(np.asarray([0.1, 0.3, 0.5]), np.asarray([0.0, 0.8, 1.0]), np.zeros(3, int))
    flat = hulls.Hull(np.asarray([0.1, 0.5]), np.asarray([0.0, 0.8]), np.zeros(2, int))
    for promise, expected in (
        (0.1, [0.1, 0.1]),
        (0.15, [0.2, 0.1]),
        (0.2, [0.3, 0.1]),
        (0.3, [0.3, 0.3]),
        (0.45, [0.4, 0.5]),
        (9.0, [0.5, 0.5]),
    ):
        found = hulls.split([steep, flat], np.asarray([0.5, 0.5]), promise)
        np.testing.assert_allclose(found, expected)
    free = hulls.split([steep, flat], np.asarray([1.0, 0.0]), 0.2)
    np.testing.assert_allclose(free, [0.2, 0.5])  # where the weight is 0, all that is of use


def test_corners_on_a_line_are_left_out():
    """Three points on a line, one below, one that earns less for more danger."""
    one = np.asarray([[0.0, 1.0, 2.0], [0.0, 1.0, 2.0]])
    other = np.asarray([[0.5, 2.5], [0.2, 1.9]])
    found = hulls._union([one, other])
    np.testing.assert_array_equal(found.danger, [0, 2])
    np.testing.assert_array_equal(found.value, [0, 2])
    np.testing.assert_array_equal(found.action, [0, 0])


def test_of_equally_dangerous_actions_the_best_is_taken():
    found = hulls._union([np.asarray([[0.3], [1.0]]), np.asarray([[0.1 + 0.2], [5.0]])])
    np.testing.assert_array_equal(found.value, [5])
    np.testing.assert_array_equal(found.action, [1])


@pytest.mark.parametrize(
    ("c", "message"),
    [
        (-1.0, r"c is -1\.0; it must be a finite number, at least 0"),
        (float("nan"), "c is nan; it must be a finite number"),
        (0.39, r"c is 0\.39; it must be at least 0\.4, the least danger of any policy"),
    ],
)
def test_what_cannot_be_promised_is_named(c, message):
    with pytest.raises(ValueError, match=message):
        hulls.hulls(counterexample_2(), c)


def test_hulls_are_of_a_finite_horizon():
    with pytest.raises(ValueError, match="horizon is None; it must be a number of steps"):
        hulls.hulls(random_cmdp(0, horizon=None), 1.0)
