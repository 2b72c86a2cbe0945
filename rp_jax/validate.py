"""Checks of user input: every message names the field, the value and what is allowed."""

import contextlib
import math
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

import jax
import numpy as np

T = TypeVar("T")

MOST = 2_000_000_000  # of anything that is counted: it has to fit into an int32


def _finite(value: float) -> bool:
    """Whether it is a finite number, in single precision too."""
    return abs(value) <= float(np.finfo(np.float32).max)  # false for nan


def one_of(field: str, value: T, allowed: Iterable[T]) -> T:
    """Returns `value` if it is one of `allowed`, else raises ValueError."""
    choices = list(allowed)
    if not any(isinstance(value, type(choice)) and value == choice for choice in choices):
        listed = ", ".join(map(repr, choices))
        raise ValueError(f"{field} is {shown(value)}; it must be one of {listed}")
    return value


@contextlib.contextmanager
def within(option: str) -> Iterator[None]:
    """A ValueError raised inside begins with the name of the option that a user knows."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{option}: {error}") from error


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
        most: largest allowed value, inclusive; for whole numbers MOST if not given.
        above: bound that must be exceeded.
        integer: whether only whole numbers are allowed.
        infinite: whether infinity is allowed. Nan never is, nor what is too large for a float32.
    """
    if integer and most is None:
        most = MOST
    rules = ["an integer" if integer else "a number" if infinite else "a finite number"]
    if least is not None:
        rules.append(f"at least {least:g}")
    if above is not None:
        rules.append(f"above {above:g}")
    if most is not None:
        rules.append(f"at most {most:g}")
    kind = (int, np.integer) if integer else (int, float, np.integer, np.floating)
    good = isinstance(value, kind) and not isinstance(value, bool)
    good = good and (_finite(value) or (infinite and value in (math.inf, -math.inf)))
    good = good and (least is None or value >= least) and (most is None or value <= most)
    good = good and (above is None or value > above)
    if not good:
        raise ValueError(f"{field} is {shown(value)}; it must be {', '.join(rules)}")
    return value


def positive(
    field: str, value: float, *, most: float | None = None, integer: bool = False
) -> float:
    """Returns `value` if it is a number above 0 (and at most `most`), else raises ValueError."""
    return number(field, value, above=0, most=most, integer=integer)


def shown(value: Any) -> str:
    """What a message says of a value: itself, or its shape and type where it is an array."""
    if isinstance(value, jax.Array | np.ndarray) and value.ndim:
        return f"{value.dtype}{list(value.shape)}"
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]}..."


def _numeric(dtype: Any) -> bool:
    return any(jax.dtypes.issubdtype(dtype, kind) for kind in (np.number, np.bool_))


def ranked(rank: int, **arrays: Any) -> None:
    """Raises ValueError, naming it, if one of some arrays is not of numbers or has other axes."""
    for field, array in arrays.items():
        good = isinstance(array, jax.Array | np.ndarray | np.generic) and array.ndim == rank
        if not good or not _numeric(array.dtype):
            axes = {0: "no axis", 1: "1 axis"}.get(rank, f"{rank} axes")
            raise ValueError(f"{field} is {shown(array)}; it must be an array of {axes}")


def leading(**trees: Any) -> int:
    """The length of the leading axis that all arrays of some pytrees share, at least 1.

    Raises:
        ValueError: naming the pytree, if there is none or another.
    """
    found = 0
    for field, tree in trees.items():
        shapes = [getattr(leaf, "shape", ()) for leaf in jax.tree.leaves(tree)]
        lengths = {shape[0] if shape else 0 for shape in shapes}
        length = lengths.pop() if len(lengths) == 1 else 0
        if length == 0 or length != (found or length):
            what = f"of shapes {', '.join(map(str, shapes[:4]))}" if shapes else shown(tree)
            allowed = f"{found}" if found else "at least 1, the same for all"
            raise ValueError(f"{field} is {what}; it must have a leading axis of length {allowed}")
        found = length
    return found


def random_key(field: str, key: Any) -> None:
    """Raises ValueError unless it is one key, made by `jax.random.key`."""
    typed = isinstance(key, jax.Array) and jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key)
    if not typed or key.shape != ():
        raise ValueError(f"{field} is {shown(key)}; it must be one key of jax.random.key")


def finite(what: str, values: Any) -> None:
    """Raises FloatingPointError if a number that was computed is nan or infinite."""
    wrong = int(np.size(values) - np.isfinite(values).sum())
    if wrong:
        raise FloatingPointError(
            f"{what}: {wrong:,} of {np.size(values):,} numbers are nan or infinite"
        )


def none_bad(what: str, counts: Any) -> None:
    """Raises FloatingPointError if a field `bad_*` of a NamedTuple of counts is not all 0."""
    for field in counts._fields:
        count = int(np.sum(getattr(counts, field))) if field.startswith("bad_") else 0
        if count:
            things = field.removeprefix("bad_")
            raise FloatingPointError(f"{what}: {things} of {count:,} steps are nan or infinite")
