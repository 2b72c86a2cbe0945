import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from rp_jax.statistics import (
    _trials,
    clopper_pearson,
    events_allowed,
    mean_interval,
    plan_test,
    upper_bound,
)

rates = st.integers(1, 300).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n)))


@given(rates, st.floats(0.5, 0.999))
def test_the_interval_of_a_rate_is_that_of_scipy(rate, confidence):
    k, n = rate
    reference = stats.binomtest(k, n).proportion_ci(confidence, method="exact")
    expected = (reference.low, reference.high)
    np.testing.assert_allclose(clopper_pearson(k, n, confidence), expected, atol=1e-6)


@given(rates, st.floats(0.5, 0.999))
def test_the_upper_bound_of_a_rate_is_that_of_scipy(rate, confidence):
    k, n = rate
    reference = stats.binomtest(k, n, alternative="less").proportion_ci(confidence, method="exact")
    np.testing.assert_allclose(upper_bound(k, n, confidence), reference.high, atol=1e-6)


def test_what_no_event_in_100_and_in_2995_episodes_excludes():
    assert 0.029 < upper_bound(0, 100) < 0.03
    assert 0.0009 < upper_bound(0, 2995) < 0.001
    assert upper_bound(0, 2994) > 0.001  # 2,995 is the least number that shows < .1 %
    np.testing.assert_allclose(upper_bound(0, 100), 1 - 0.05**0.01, rtol=1e-9)


def test_the_ends_of_the_range_are_exact():
    assert clopper_pearson(0, 10)[0] == 0.0
    assert clopper_pearson(10, 10)[1] == 1.0
    assert upper_bound(10, 10) == 1.0
    low, high = clopper_pearson(1, 1)
    assert (round(low, 6), high) == (0.025, 1.0)


@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.99])
@pytest.mark.parametrize("n", [7, 40])
def test_the_interval_covers_every_rate_as_often_as_it_says(n, confidence):
    bounds = np.asarray([clopper_pearson(k, n, confidence) for k in range(n + 1)])
    one_sided = np.asarray([upper_bound(k, n, confidence) for k in range(n + 1)])
    for rate in np.linspace(0.001, 0.999, 333):
        chance = stats.binom.pmf(np.arange(n + 1), n, rate)
        inside = (bounds[:, 0] <= rate) & (rate <= bounds[:, 1])
        assert chance[inside].sum() >= confidence - 1e-9
        assert chance[rate <= one_sided].sum() >= confidence - 1e-9


def test_simulated_rates_are_covered():
    events = np.random.default_rng(0).binomial(200, 0.03, 2000)
    bounds = {k: clopper_pearson(k, 200) for k in np.unique(events)}
    covered = np.mean([bounds[k][0] <= 0.03 <= bounds[k][1] for k in events])
    assert 0.945 < covered < 0.995


@pytest.mark.parametrize("interval", [clopper_pearson, upper_bound])
@pytest.mark.parametrize(
    ("k", "n", "confidence", "message"),
    [
        (-1, 10, 0.95, "^k is -1; it must be an integer, at least 0, at most 10"),
        (11, 10, 0.95, "^k is 11; it must be an integer, at least 0, at most 10"),
        (0.5, 10, 0.95, "^k is 0.5; it must be an integer"),
        (0, 0, 0.95, "^n is 0; it must be an integer, at least 1"),
        (1, 10, 0.0, "^confidence is 0.0; it must be a finite number, above 0"),
        (1, 10, 1.0, "^confidence is 1.0; it must be below 1"),
        (1, 10, 95, "^confidence is 95; it must be below 1"),
        (1, 10, float("nan"), "^confidence is nan"),
    ],
)
def test_impossible_counts_and_confidences_are_refused(interval, k, n, confidence, message):
    with pytest.raises(ValueError, match=message):
        interval(k, n, confidence)


def test_the_interval_of_a_mean_is_students():
    values = np.asarray([1.0, 2.0, 4.0, 8.0])
    mean, width = mean_interval(values, 0.9)
    low, high = stats.t.interval(0.9, 3, values.mean(), stats.sem(values))
    np.testing.assert_allclose((mean - width, mean + width), (low, high), rtol=1e-12)


@pytest.mark.parametrize("confidence", [0.8, 0.95])
def test_the_interval_of_a_mean_covers_it_as_often_as_it_says(confidence):
    samples = np.random.default_rng(1).normal(3.0, 2.0, (4000, 5))
    intervals = [mean_interval(row, confidence) for row in samples]
    covered = np.mean([abs(mean - 3.0) <= width for mean, width in intervals])
    assert abs(covered - confidence) < 4 * np.sqrt(confidence * (1 - confidence) / 4000)


def test_the_mean_of_one_value_has_no_width():
    mean, width = mean_interval([2.5])
    assert mean == 2.5
    assert np.isnan(width)


def test_equal_values_have_an_interval_of_width_zero():
    assert mean_interval(np.full(5, 7.0)) == (7.0, 0.0)


def test_the_mean_of_no_values_and_bad_confidences_are_refused():
    with pytest.raises(ValueError, match=r"^number of values is 0; it must be .*at least 1"):
        mean_interval([])
    with pytest.raises(ValueError, match=r"^confidence is 1\.5"):
        mean_interval([1.0, 2.0], 1.5)


@pytest.mark.parametrize(
    ("c", "confidence", "expected"), [(1e-3, 0.99, 5e-4), (0.05, 0.95, 0.0), (0.2, 0.9, 0.1)]
)
def test_a_planned_test_is_the_smallest_that_can_show_the_rate(c, confidence, expected):
    n, k = plan_test(c, confidence, expected, 0.9)
    assert upper_bound(k, n, confidence) <= c
    assert upper_bound(k, n - 1, confidence) > c
    assert stats.binom.cdf(k, n, expected) >= 0.9
    if k > 0:  # fewer events allowed would fail an agent that shall pass
        fewer = next(m for m in range(k, n) if upper_bound(k - 1, m, confidence) <= c)
        assert stats.binom.cdf(k - 1, fewer, expected) < 0.9


@given(st.floats(1e-3, 0.3), st.floats(0.8, 0.999), st.floats(0.0, 0.7), st.floats(0.5, 0.95))
@settings(max_examples=30)
def test_no_smaller_test_has_the_power(c, confidence, share, power):
    _, k = plan_test(c, confidence, share * c, power)
    for fewer in range(k):
        assert stats.binom.cdf(fewer, _trials(fewer, c, confidence), share * c) < power


def test_a_test_that_takes_millions_of_events_is_planned_at_once_or_refused():
    n, k = plan_test(1e-3, 0.99, 9.9e-4, 0.9)
    assert 1e8 < n < 2e9
    assert k > 1e5
    with pytest.raises(ValueError, match=r"^c is .* episodes; it must take 2,000,000,000 at most"):
        plan_test(1e-3, 0.99, 9.999e-4, 0.9)


def test_no_event_in_2995_shows_less_than_a_thousandth():
    assert plan_test(1e-3, 0.95, 0.0, 0.9) == (2995, 0)


@pytest.mark.parametrize(
    "values",
    [(0.0, 0.9, 0.0, 0.9), (0.1, 0.9, 0.1, 0.9), (0.1, 0.9, -0.1, 0.9), (1.0, 0.9, 0, 0.9)],
)
def test_a_test_that_cannot_be_planned_is_refused(values):
    with pytest.raises(ValueError, match=r"^(c|expected) is"):
        plan_test(*values)


@pytest.mark.parametrize(
    ("n", "rate", "k"),
    [
        (2995, 1e-3, 0),  # 1 - .05^(1 / n) is .99974e-3 with 2,995, 1.00007e-3 with 2,994
        (2994, 1e-3, -1),
        (0, 0.5, -1),
        (59, 0.05, 0),  # .95^59 = .0485
        (93, 0.05, 1),  # .95^93 + 93 * .05 * .95^92 = .0500 - .0006
        (92, 0.05, 0),
    ],
)
def test_the_most_events_that_a_bound_allows(n, rate, k):
    assert events_allowed(n, rate) == k
    if k >= 0:
        assert upper_bound(k, n, 0.95) <= rate < upper_bound(k + 1, n, 0.95)
