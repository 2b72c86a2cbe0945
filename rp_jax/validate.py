"""Checks of user input: every message names the field, the value and what is allowed."""

import math
import numbers
from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")


def _float(value: float) -> float:
    """As a float; infinite where it is too large for one."""
    try:
        return float(value)
    except OverflowError:
        return math.inf


def one_of(field: str, value: T, allowed: Iterable[T]) -> T:
    """Returns `value` if it is one of `allowed`, else raises ValueError."""
    choices = list(allowed)
    if value not in choices:
        raise ValueError(f"{field} is {value!r}; it must be one of {', '.join(map(repr, choices))}")
    return value


def number(
    field: str,
    value: float,
    *,
    least: float | None = None,
    most: float | None = None,
    above: float | None = None,
    integer: bool = False,
    infinite: bool = False,
) -> float:
    """Returns `value` if it is a number in the range, else raises ValueError.

    Args:
        field: name in the message.
        value: what the user gave.
        least: smallest allowed value, inclusive.
        most: largest allowed value, inclusive.
        above: bound that must be exceeded.
        integer: whether only whole numbers are allowed.
        infinite: whether infinity is allowed. Nan never is.
    """
    rules = ["an integer" if integer else "a number" if infinite else "a finite number"]
    if least is not None:
        rules.append(f"at least {least:g}")
    if above is not None:
        rules.append(f"above {above:g}")
    if most is not None:
        rules.append(f"at most {most:g}")
    kind = numbers.Integral if integer else numbers.Real
    good = isinstance(value, kind) and not isinstance(value, bool)
    good = good and not math.isnan(_float(value)) and (infinite or math.isfinite(_float(value)))
    good = good and (least is None or value >= least) and (most is None or value <= most)
    good = good and (above is None or value > above)
    if not good:
        raise ValueError(f"{field} is {value!r}; it must be {', '.join(rules)}")
    return value


def positive(
    field: str, value: float, *, most: float | None = None, integer: bool = False
) -> float:
    """Returns `value` if it is a number above 0 (and at most `most`), else raises ValueError."""
    return number(field, value, above=0, most=most, integer=integer)


def finite(what: str, values: Any) -> None:
    """Raises FloatingPointError if a number that was computed is nan or infinite."""
    wrong = int(np.size(values) - np.isfinite(values).sum())
    if wrong:
        raise FloatingPointError(
            f"{what}: {wrong:,} of {np.size(values):,} numbers are nan or infinite"
        )
