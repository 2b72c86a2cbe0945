"""Checks of user input: every message names the field, its value and what is allowed."""

import contextlib
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

T = TypeVar("T")

MOST = 2_000_000_000  # the largest allowed count of anything: it has to fit into an int32


def _finite(value: float) -> bool:
    """Returns whether a number is finite, in single precision too."""
    return abs(value) <= float(np.finfo(np.float32).max)  # false for nan


def one_of(field: str, value: T, allowed: Iterable[T]) -> T:
    """Returns a value that is one of the allowed ones, and raises ValueError otherwise.

    Args:
        field: name of the value, for the message.
        value: what the user gave.
        allowed: the choices; the value must equal one of them and have its type.

    Returns:
        The value, unchanged.

    Raises:
        ValueError: the value is none of the choices.
    """
    choices = list(allowed)
    if not any(isinstance(value, type(choice)) and value == choice for choice in choices):
        listed = ", ".join(map(repr, choices))
        raise ValueError(f"{field} is {shown(value)}; it must be one of {listed}")
    return value


@contextlib.contextmanager
def within(option: str) -> Iterator[None]:
    """Puts an option's name in front of the message of a ValueError raised inside the context.

    Args:
        option: the name by which the user knows what was wrong.

    Raises:
        ValueError: the one raised inside, with its new message.
    """
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
    """Returns a value that is a number in a range, and raises ValueError otherwise.

    Args:
        field: name of the value, for the message.
        value: what the user gave.
        least: smallest allowed value, inclusive.
        most: largest allowed value, inclusive; `MOST` by default for whole numbers.
        above: bound that the value must exceed.
        integer: whether only whole numbers are allowed.
        infinite: whether infinity is allowed. Nan never is, nor is a finite number that is too
            large for a float32.

    Returns:
        The value, unchanged.

    Raises:
        ValueError: the value is not a number, or is out of range.
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
    """Returns a value that is a number above 0, and raises ValueError otherwise.

    Args:
        field: name of the value, for the message.
        value: what the user gave.
        most: largest allowed value, inclusive.
        integer: whether only whole numbers are allowed.

    Returns:
        The value, unchanged.

    Raises:
        ValueError: the value is not a number, or is out of range.
    """
    return number(field, value, above=0, most=most, integer=integer)


def shown(value: Any) -> str:
    """Returns how a message shows a value: its text, or an array's type and shape.

    Args:
        value: anything; texts of more than 200 characters are cut.
    """
    if isinstance(value, jax.Array | np.ndarray) and value.ndim:
        return f"{value.dtype}{list(value.shape)}"
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]}..."


def _numeric(dtype: Any) -> bool:
    """Returns whether arrays of this type hold numbers or booleans."""
    return any(jax.dtypes.issubdtype(dtype, kind) for kind in (np.number, np.bool_))


def ranked(rank: int, **arrays: Any) -> None:
    """Raises ValueError unless all given arrays are numeric and have `rank` axes.

    Args:
        rank: the number of axes that each array must have.
        **arrays: the arrays by name; a message names the first one that is wrong.

    Raises:
        ValueError: an argument is not a numeric array, or has another number of axes.
    """
    for field, array in arrays.items():
        good = isinstance(array, jax.Array | np.ndarray | np.generic) and array.ndim == rank
        if not good or not _numeric(array.dtype):
            axes = {0: "no axis", 1: "1 axis"}.get(rank, f"{rank} axes")
            raise ValueError(f"{field} is {shown(array)}; it must be an array of {axes}")


def shared_length(**trees: Any) -> int:
    """Returns the length of the leading axis that all arrays of some pytrees share.

    Args:
        **trees: the pytrees by name.

    Returns:
        The length, at least 1.

    Raises:
        ValueError: an array of a pytree has no leading axis, or one of another length; the message
            names the pytree.
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


def path(field: str, value: Any) -> Path:
    """Returns a path, and raises ValueError for anything that is none.

    Args:
        field: name of the value, for the message.
        value: what the user gave.

    Raises:
        ValueError: the value is neither text nor a path.
    """
    if not isinstance(value, str | Path):
        raise ValueError(f"{field} is {shown(value)}; it must be a path")
    return Path(value)


def random_key(field: str, key: Any) -> None:
    """Raises ValueError unless the value is a single key made by `jax.random.key`.

    Args:
        field: name of the value, for the message.
        key: what the user gave.

    Raises:
        ValueError: the value is not a typed key, or is an array of several keys.
    """
    typed = isinstance(key, jax.Array) and jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key)
    if not typed or key.shape != ():
        raise ValueError(f"{field} is {shown(key)}; it must be one key of jax.random.key")


def finite(what: str, values: Any) -> None:
    """Raises FloatingPointError if a computed array holds nan or infinity.

    Args:
        what: name of the numbers, for the message.
        values: array of any shape.

    Raises:
        FloatingPointError: at least one number is not finite; the message says how many are not.
    """
    wrong = int(np.size(values) - np.isfinite(values).sum())
    if wrong:
        raise FloatingPointError(
            f"{what}: {wrong:,} of {np.size(values):,} numbers are nan or infinite"
        )


def none_bad(what: str, counts: Any) -> None:
    """Raises FloatingPointError unless all fields of a NamedTuple that begin with `bad_` are 0.

    Args:
        what: name of the computation, for the message.
        counts: NamedTuple whose fields named `bad_...` count steps with numbers that are nan or
            infinite.

    Raises:
        FloatingPointError: a count is not 0; the message names its field.
    """
    for field in counts._fields:
        count = int(np.sum(getattr(counts, field))) if field.startswith("bad_") else 0
        if count:
            things = field.removeprefix("bad_")
            raise FloatingPointError(f"{what}: {things} of {count:,} steps are nan or infinite")
