"""Comparisons of numbers up to rounding, and of samples up to chance."""

from typing import Any

import jax
import numpy as np

from rp_jax.envs.check.batches import flat
from rp_jax.envs.check.problems import same_structure, value_of

LARGE = 0.4  # share of cases from which on a world does not merely make an exception
RARE = 1e-3  # share of cases that rounding may turn over
LEVEL = 1e-4  # chance that any two samples of one distribution in a check are told apart


def unequal(a: Any, b: Any, before: Any = None) -> np.ndarray:
    """Returns which rows differ beyond rounding, (n,) bool; nan equals nan.

    Args:
        a: pytree, leading axis (n,).
        b: alike.
        before: alike, the state before the step to `a` or `b`: rounding is judged by the size of
            a step as well.
    """
    a, b = flat(a), flat(b)
    size = np.max(np.abs(b), axis=0, initial=0.0, where=np.isfinite(b))
    allowed = 1e-5 * size + 1e-7
    if before is not None:
        change = np.abs(b - flat(before))
        allowed += 1e-3 * np.max(change, axis=0, initial=0.0, where=np.isfinite(change))
    else:
        allowed += 1e-4 * size
    with np.errstate(invalid="ignore"):
        same = (np.abs(a - b) <= allowed) | (a == b) | (np.isnan(a) & np.isnan(b))
    return ~same.all(axis=1)


def tolerance_of(features: np.ndarray, *pairs: Any, loose: float = 1e-4) -> np.ndarray:
    """Returns by how much features (F,) may differ by rounding.

    Args:
        features: (n, F) that occur.
        *pairs: pytrees of the bodies and hazards that they are of, leading axis (n,).
        loose: share of the largest features that rounding may amount to.
    """
    spread = np.max(np.abs(features), axis=0, initial=0.0, where=np.isfinite(features))
    largest = max((np.max(np.abs(flat(tree)), initial=0.0) for tree in pairs), default=0.0)
    return loose * spread + 1e-5 * min(max(largest, spread.max()), 1e4) + 1e-6


def beyond(a: np.ndarray, b: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
    """Returns which rows of features (n, F) differ by more than a tolerance (F,), (n,) bool.

    Args:
        a: features of one kind.
        b: features to compare them with.
        tolerance: greatest difference of each.
    """
    return ~(np.abs(a - b) <= tolerance).all(axis=1)


def first_difference(a: Any, b: Any, names: str, bits: bool) -> str | None:
    """Returns a text on the first leaf in which two pytrees differ, None if in none.

    Args:
        a: pytree of arrays.
        b: alike; if its structure is another, that is what differs.
        names: of the pytree, for the text.
        bits: whether every bit must be the same; otherwise rounding is allowed.
    """
    if not same_structure(a, b):
        return f"the structure of {names}"
    leaves = jax.tree_util.tree_flatten_with_path(a)[0]
    for (path, one), other in zip(leaves, jax.tree.leaves(b), strict=True):
        one, other = np.asarray(one), np.asarray(other)
        same = one.shape == other.shape and np.array_equal(one, other, equal_nan=True)
        if not same and not bits and one.shape == other.shape:
            x, y = one.astype(float), other.astype(float)
            size = np.max(np.abs(x), initial=1.0, where=np.isfinite(x))
            same = np.allclose(x, y, rtol=0, atol=1e-3 * size, equal_nan=True)
        if not same:
            where = f"{names}{jax.tree_util.keystr(path)}"
            return f"{where} is {value_of(one)} and {value_of(other)}"
    return None


def told_apart(a: np.ndarray, b: np.ndarray, tolerance: np.ndarray, level: float) -> bool:
    """Returns whether two samples are of different distributions.

    By the test of Kolmogorov and Smirnov for each column, in the bound of Massart for two samples,
    which holds for discrete distributions too, with Bonferroni's correction. Values that differ
    by no more than a tolerance count as equal.

    Args:
        a: (n, F).
        b: (m, F).
        tolerance: (F,).
        level: chance that two samples of one distribution are told apart, at most.
    """
    n, m = len(a), len(b)
    allowed = np.sqrt((1 + np.log(a.shape[1] / level)) * (n + m) / (2 * n * m))
    return any(
        _distance(x, y, slack) > allowed
        for x, y, slack in zip(a.T, b.T, np.broadcast_to(tolerance, a.shape[1:]), strict=True)
    )


def _distance(x: np.ndarray, y: np.ndarray, slack: float) -> float:
    """The largest difference of two distributions that no shift up to `slack` explains."""
    x, y = np.sort(x), np.sort(y)
    above = _below(x, x) - _below(y, x + slack)
    under = _below(y, y) - _below(x, y + slack)
    return max(above.max(), under.max())


def _below(sample: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.searchsorted(sample, values, side="right") / len(sample)
