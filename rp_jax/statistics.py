"""Honest statistics: intervals for rates and means, over episodes and over seeds."""

import numpy as np
from scipy import stats

from rp_jax.validate import MOST, number


def clopper_pearson(k: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Exact two-sided interval of a rate, k events of n.

    Raises:
        ValueError: not 0 <= k <= n, n < 1, or a confidence outside (0, 1).
    """
    number("n", n, least=1, integer=True)
    number("k", k, least=0, most=n, integer=True)
    _check_confidence(confidence)
    tail = (1 - confidence) / 2
    lower = 0.0 if k == 0 else float(stats.beta.ppf(tail, k, n - k + 1))
    upper = 1.0 if k == n else float(stats.beta.ppf(1 - tail, k + 1, n - k))
    return lower, upper


def upper_bound(k: int, n: int, confidence: float = 0.95) -> float:
    """Exact one-sided upper bound of a rate: what k events of n exclude."""
    number("n", n, least=1, integer=True)
    number("k", k, least=0, most=n, integer=True)
    _check_confidence(confidence)
    return 1.0 if k == n else float(stats.beta.ppf(confidence, k + 1, n - k))


def plan_test(c: float, confidence: float, expected: float, power: float) -> tuple[int, int]:
    """The smallest number of trials that can show a rate to be at most c, and the events allowed.

    Args:
        c: the rate not to be exceeded.
        confidence: of the one-sided exact bound that must not exceed c.
        expected: a rate below c that shall pass.
        power: with at least this probability.

    Returns:
        (n, k): k or fewer events in n trials show it.

    Raises:
        ValueError: a value is out of range, or more than `MOST` trials are needed.
    """
    _check_confidence(confidence)
    number("c", c, above=0)
    number("expected", expected, least=0)
    number("power", power, above=0)
    if not expected < c < 1 or power >= 1:
        raise ValueError(
            f"expected is {expected!r}, c is {c!r} and power is {power!r}; they must keep "
            "0 <= expected < c < 1 and 0 < power < 1"
        )

    def power_of(k: int) -> float:
        return stats.binom.cdf(k, _trials(k, c, confidence), expected)

    low, high = -1, 0  # low is too few events, high may be
    while power_of(high) < power:
        low, high = high, 2 * high + 1
        number("expected: episodes needed", _trials(high, c, confidence), most=MOST)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if power_of(middle) >= power else (middle, high)
    # More events have more power, but for the last few, since trials come whole.
    k = next(k for k in range(max(0, high - 10), high + 1) if power_of(k) >= power)
    return _trials(k, c, confidence), k


def _trials(k: int, c: float, confidence: float) -> int:
    """The fewest trials among which k events exclude a rate above c."""
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
    """The most events of n whose one-sided exact bound is at most `rate`; -1 if not even none."""
    k = int(stats.binom.ppf(1 - confidence, n, rate)) + 1 if n else -1
    while k >= 0 and (k > n or upper_bound(k, n, confidence) > rate):
        k -= 1
    return k


def mean_interval(values: np.ndarray, confidence: float = 0.95) -> tuple[float, float]:
    """(mean, half-width) of Student's interval; the half-width is nan for one value."""
    _check_confidence(confidence)
    values = np.asarray(values, float)
    n = values.size
    number("number of values", n, least=1)
    if n == 1:
        return float(values.mean()), float("nan")
    width = stats.t.ppf((1 + confidence) / 2, n - 1) * values.std(ddof=1) / np.sqrt(n)
    return float(values.mean()), float(width)


def _check_confidence(confidence: float) -> None:
    number("confidence", confidence, above=0)
    if confidence >= 1:
        raise ValueError(f"confidence is {confidence!r}; it must be below 1")
