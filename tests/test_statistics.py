import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from rp_jax.statistics import (
    _trials,
    clopper_pearson,
    cluster_interval,
    cluster_upper_bound,
    events_allowed,
    mean_interval,
    plan_test,
    upper_bound,
    variance_split,
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


def test_the_interval_over_clusters_by_hand():
    # Rates .1 and .3: variance of the mean .01, of 20 independent trials .2 * .8 / 20 = .008.
    low, high = cluster_interval([1, 3], [10, 10])
    independent = 20 / 1.25 * (stats.t.ppf(0.975, 19) / stats.t.ppf(0.975, 1)) ** 2
    k = 0.2 * independent
    np.testing.assert_allclose(low, stats.beta.ppf(0.025, k, independent - k + 1), rtol=1e-12)
    np.testing.assert_allclose(high, stats.beta.ppf(0.975, k + 1, independent - k), rtol=1e-12)
    assert cluster_upper_bound([1, 3], [10, 10], 0.975) == high


def test_clusters_that_are_alike_are_no_better_than_independent_trials():
    pooled = clopper_pearson(50, 1000)
    low, high = cluster_interval([5] * 10, [100] * 10)
    assert low < pooled[0] < pooled[1] < high
    many = cluster_interval([1] * 1000, [20] * 1000)  # where nothing is lost for few clusters
    np.testing.assert_allclose(many, clopper_pearson(1000, 20_000), rtol=2e-3)


def test_clusters_at_the_ends_of_the_range():
    assert cluster_interval([7], [10]) == (0.0, 1.0)  # one cluster says nothing of others
    assert cluster_interval([0, 0], [10, 10])[0] == 0.0
    assert cluster_interval([10, 10], [10, 10])[1] == 1.0
    # No event in ten agents of 10,000 episodes: as many as (1.96 / 2.262)^2 = .751 of them show.
    np.testing.assert_allclose(cluster_interval([0] * 10, [10_000] * 10)[1], 4.91e-5, rtol=2e-3)


@pytest.mark.parametrize(("spread", "least"), [(0.0, 0.95), (0.5, 0.94), (1.0, 0.9)])
@pytest.mark.parametrize("clusters", [3, 10])
@pytest.mark.parametrize("mean", [0.1, 2, 100])
def test_the_coverage_of_both_intervals_over_unlike_clusters(spread, least, clusters, mean):
    """Rates of clusters are drawn from gamma distributions: what the intervals say is counted."""
    rng, trials, rate = np.random.default_rng(0), 10_000, mean / 10_000
    rates = np.full((400, clusters), rate)
    if spread:
        rates = np.minimum(rng.gamma(1 / spread**2, rate * spread**2, rates.shape), 1.0)
    events = rng.binomial(trials, rates)
    own = [clopper_pearson(int(k.sum()), clusters * trials) for k in events]
    of_method = [cluster_interval(k, [trials] * clusters) for k in events]

    def covers(found, truth):
        return np.mean([a <= t <= b for (a, b), t in zip(found, truth, strict=True)])

    assert covers(own, rates.mean(axis=1)) >= 0.93  # of these clusters, whatever their spread
    assert covers(of_method, [rate] * 400) >= least - 0.02
    if spread == 1.0 and mean == 100:
        assert covers(own, [rate] * 400) < 0.3  # what pooled episodes do not say


def test_where_no_cluster_has_an_event_the_bound_covers_unlike_clusters():
    rng, covered = np.random.default_rng(1), []
    for _ in range(2000):
        rates = rng.gamma(1.0, 3e-5, 3)
        events = rng.binomial(10_000, rates)
        if events.sum() == 0:
            covered.append(cluster_upper_bound(events, [10_000] * 3) >= 3e-5)
    assert len(covered) > 500
    assert np.mean(covered) >= 0.95


@pytest.mark.parametrize(
    ("events", "trials", "words"),
    [
        ([], [], "number of clusters is 0; it must be"),
        ([1, 2], [10], "events has 2 clusters and trials 1"),
        ([11, 2], [10, 10], "events is 11; it must be"),
        ([0, 0], [10, 0], "trials is 0; it must be"),
    ],
)
def test_clusters_that_make_no_sense_are_refused(events, trials, words):
    with pytest.raises(ValueError, match=words):
        cluster_interval(events, trials)


def test_variance_is_split_between_groups_and_within_them_by_hand():
    # Means 2 and 6 (variance 8); within each group variance 2.
    found = variance_split([[1.0, 3.0], [5.0, 7.0]])
    assert (found.within, found.between) == (2.0, 7.0)
    assert found.share == pytest.approx(7 / 9)
    assert variance_split([[1.0, 3.0], [3.0, 1.0]]).between == 0.0
    with pytest.raises(ValueError, match=r"groups have \[2, 1\] values"):
        variance_split([[1.0, 2.0], [3.0]])


def test_variance_splits_are_unbiased():
    rng = np.random.default_rng(2)
    groups = rng.normal(0, 3.0, (4000, 4, 1)) + rng.normal(0, 1.0, (4000, 4, 3))
    found = [variance_split(values) for values in groups]
    assert np.mean([split.between for split in found]) == pytest.approx(9.0, rel=0.05)
    assert np.mean([split.within for split in found]) == pytest.approx(1.0, rel=0.05)
