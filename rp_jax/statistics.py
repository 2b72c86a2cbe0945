"""Confidence intervals for rates and means, over episodes and over seeds."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from rp_jax.validate import MOST, number


def clopper_pearson(k: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Returns the exact two-sided confidence interval of a rate (Clopper and Pearson 1934).

    Args:
        k: number of events.
        n: number of trials.
        confidence: probability with which the interval holds the true rate, in (0, 1).

    Returns:
        (lower, upper) end.

    Raises:
        ValueError: a number is out of range.
    """
    number("n", n, least=1, integer=True)
    number("k", k, least=0, most=n, integer=True)
    _check_confidence(confidence)
    tail = (1 - confidence) / 2
    lower = 0.0 if k == 0 else float(stats.beta.ppf(tail, k, n - k + 1))
    upper = 1.0 if k == n else float(stats.beta.ppf(1 - tail, k + 1, n - k))
    return lower, upper


def upper_bound(k: int, n: int, confidence: float = 0.95) -> float:
    """Returns the exact one-sided upper confidence bound of a rate.

    Args:
        k: number of events.
        n: number of trials.
        confidence: probability with which the true rate is at most the bound, in (0, 1).

    Raises:
        ValueError: a number is out of range.
    """
    number("n", n, least=1, integer=True)
    number("k", k, least=0, most=n, integer=True)
    _check_confidence(confidence)
    return 1.0 if k == n else float(stats.beta.ppf(confidence, k + 1, n - k))


def plan_test(c: float, confidence: float, expected: float, power: float) -> tuple[int, int]:
    """Returns the smallest test that can show a rate to be at most c.

    Args:
        c: the rate not to be exceeded.
        confidence: level of the exact upper bound (`upper_bound`), which must not exceed c.
        expected: a true rate below c at which the test should succeed.
        power: probability of success that is wanted at the rate `expected`.

    Returns:
        (n, k): the test succeeds if n trials show k events or fewer.

    Raises:
        ValueError: a value is out of range, or more than `MOST` trials are needed.
    """
    _check_confidence(confidence)
    for name, value in (("c", c), ("power", power)):
        if number(name, value, above=0) >= 1:
            raise ValueError(f"{name} is {value!r}; it must be a number above 0 and below 1")
    if number("expected", expected, least=0) >= c:
        raise ValueError(
            f"expected is {expected!r}; it must be a number from 0 on that is less than c, {c!r}"
        )

    def power_of(k: int) -> float:
        return stats.binom.cdf(k, _trials(k, c, confidence), expected)

    low, high = -1, 0  # `low` events are too few; at the end `high` are enough
    while power_of(high) < power:
        low, high = high, 2 * high + 1
        if (trials := _trials(high, c, confidence)) > MOST:
            raise ValueError(
                f"c is {c!r} and expected is {expected!r}; to tell them apart takes {trials:,} or "
                f"more episodes; it must take {MOST:,} at most: c must be greater or expected less"
            )
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if power_of(middle) >= power else (middle, high)
    # The power grows with k except over the last few values, since n is a whole number.
    k = next(k for k in range(max(0, high - 10), high + 1) if power_of(k) >= power)
    return _trials(k, c, confidence), k


def _trials(k: int, c: float, confidence: float) -> int:
    """Returns the fewest trials among which k events exclude a rate above c."""
    low, high = k, k + 2
    while stats.binom.cdf(k, high, c) > 1 - confidence:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        if stats.binom.cdf(k, middle, c) > 1 - confidence:
            low = middle
        else:
            high = middle
    return high


def events_allowed(n: int, rate: float, confidence: float = 0.95) -> int:
    """Returns the most events in n trials for which `upper_bound` is at most a given rate.

    Args:
        n: number of trials.
        rate: the rate that the bound must not exceed.
        confidence: level of the bound, in (0, 1).

    Returns:
        The number of events; -1 if the bound of no event at all exceeds the rate.
    """
    k = int(stats.binom.ppf(1 - confidence, n, rate)) + 1 if n else -1
    while k >= 0 and (k > n or upper_bound(k, n, confidence) > rate):
        k -= 1
    return k


def mean_interval(values: np.ndarray, confidence: float = 0.95) -> tuple[float, float]:
    """Returns the mean of some values with Student's confidence interval.

    Args:
        values: (n,) independent values.
        confidence: probability with which the interval holds the true mean, in (0, 1).

    Returns:
        (mean, half-width of the interval); the half-width is nan for a single value.

    Raises:
        ValueError: there is no value, or the confidence is out of range.
    """
    _check_confidence(confidence)
    values = np.asarray(values, float)
    n = values.size
    number("number of values", n, least=1)
    if n == 1:
        return float(values.mean()), float("nan")
    width = stats.t.ppf((1 + confidence) / 2, n - 1) * values.std(ddof=1) / np.sqrt(n)
    return float(values.mean()), float(width)


def cluster_interval(
    events: Sequence[int], trials: Sequence[int], confidence: float = 0.95
) -> tuple[float, float]:
    """Returns a confidence interval of the mean rate of clusters that may differ, such as seeds.

    `clopper_pearson` of all trials together speaks of these clusters alone. This interval speaks of
    what they were drawn from: it holds the mean rate of all clusters that might have been drawn. It
    is that of Korn and Graubard (1998): Clopper and Pearson's, for as many independent trials as
    would have the variance that is seen between the clusters, and fewer still for how badly few
    clusters tell it. The variance is never taken to be less than that of independent trials, so the
    interval is the wider one of the two.

    Args:
        events: (g,) number of events in each cluster.
        trials: (g,) number of trials in each cluster.
        confidence: probability with which the interval holds the mean rate, in (0, 1). It is kept,
            or missed by a few per cent where rates differ by more than their mean; tests say how
            much (docs/statistics.md).

    Returns:
        (lower, upper) end; (0, 1) for a single cluster, which says nothing of others.

    Raises:
        ValueError: a number is out of range, or there are no clusters.
    """
    _check_confidence(confidence)
    if len(events) != len(trials):
        raise ValueError(
            f"events has {len(events)} clusters and trials {len(trials)}; they must have as many"
        )
    number("number of clusters", len(trials), least=1, integer=True)
    for k, n in zip(events, trials, strict=True):
        number("trials", n, least=1, integer=True)
        number("events", k, least=0, most=n, integer=True)
    if len(trials) == 1:
        return 0.0, 1.0
    total, happened = float(sum(trials)), float(sum(events))
    at = (1 + confidence) / 2
    shrunk = (stats.t.ppf(at, total - 1) / stats.t.ppf(at, len(trials) - 1)) ** 2
    share = shrunk / _design_effect(np.asarray(events), np.asarray(trials))
    k, others = share * happened, share * (total - happened)
    lower = float(stats.beta.ppf(1 - at, k, others + 1)) if happened > 0 else 0.0
    upper = float(stats.beta.ppf(at, k + 1, others)) if happened < total else 1.0
    return lower, upper


def cluster_upper_bound(
    events: Sequence[int], trials: Sequence[int], confidence: float = 0.95
) -> float:
    """Returns a one-sided upper confidence bound of the mean rate of clusters that may differ.

    Args:
        events: (g,) number of events in each cluster, as for `cluster_interval`.
        trials: (g,) number of trials in each cluster.
        confidence: probability with which the mean rate is at most the bound, above .5.

    Raises:
        ValueError: a number is out of range, or there are no clusters.
    """
    _check_confidence(confidence)
    number("confidence", confidence, above=0.5)
    return cluster_interval(events, trials, 2 * confidence - 1)[1]


def _design_effect(events: np.ndarray, trials: np.ndarray) -> float:
    """Returns how many times greater the variance of the rate is than that of independent trials.

    At least 1; the variance is that of a ratio of sums over clusters.
    """
    n, rate = trials.sum(), events.sum() / trials.sum()
    alike = rate * (1 - rate) / n
    if alike == 0:
        return 1.0
    g = len(trials)
    seen = g / (g - 1) * np.sum(np.square(events - rate * trials)) / float(n) ** 2
    return max(1.0, float(seen / alike))


class Split(NamedTuple):
    """Variances of a number that depends on two sources of chance, one drawn within the other."""

    between: float  # variance due to the outer one, such as the threat fit; at least 0
    within: float  # variance due to the inner one, such as the planner's seed
    share: float  # of `between` in the sum of both; nan where both are 0


def variance_split(groups: Sequence[Sequence[float]]) -> Split:
    """Splits the variance of some values into that between groups and that within them.

    One-way analysis of variance with random effects: unbiased but for the cut at 0.

    Args:
        groups: (f, s) values: at least two groups of at least two, of one size.

    Raises:
        ValueError: there are too few, or they differ in number.
    """
    sizes = {len(group) for group in groups}
    if len(groups) < 2 or len(sizes) != 1 or min(sizes) < 2:
        raise ValueError(
            f"groups have {[len(group) for group in groups]} values; there must be at least 2 "
            "groups of at least 2 values, all of one size"
        )
    values = np.asarray(groups, float)
    size = values.shape[1]
    within = float(np.mean(np.var(values, axis=1, ddof=1)))
    between = max(0.0, float(np.var(values.mean(axis=1), ddof=1)) - within / size)
    total = between + within
    return Split(between, within, between / total if total > 0 else float("nan"))


def _check_confidence(confidence: float) -> None:
    """Raises ValueError unless a confidence lies in (0, 1)."""
    number("confidence", confidence, above=0)
    if confidence >= 1:
        raise ValueError(f"confidence is {confidence!r}; it must be below 1")
