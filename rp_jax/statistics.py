"""Confidence intervals for rates and means, over episodes and over seeds."""

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


def _check_confidence(confidence: float) -> None:
    """Raises ValueError unless a confidence lies in (0, 1)."""
    number("confidence", confidence, above=0)
    if confidence >= 1:
        raise ValueError(f"confidence is {confidence!r}; it must be below 1")
