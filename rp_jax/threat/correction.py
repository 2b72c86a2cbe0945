"""Calibration of what is compared with the threshold: the sum over hazards, at every level."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax import statistics
from rp_jax.validate import number

LEVELS = (1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 0.1, 0.2, 0.5)  # of threat, for which it is stated
LEAST = 1e-7  # threats below are corrected as this one is
MARGIN = 0.999  # by which what is called more lies above a limit: more than rounding errors
APART = 0.9999  # the least ratio of two limits


class SumCorrection(struct.PyTreeNode):
    """Raises threats where they were found to be too low; straight lines between logarithms."""

    said: Array  # (L,) ascending: what a threat has to be at most, to be called at most its level
    level: Array  # (L,) ascending levels of true threat; the last is 1, and has no statement

    def __call__(self, threat: Array) -> Array:
        """Returns threats that are nowhere lower, in the same order.

        Args:
            threat: (...) sums over hazards.
        """
        said, level = jnp.log(self.said), jnp.log(self.level)
        at = jnp.log(jnp.maximum(threat, LEAST))
        raised = jnp.exp(jnp.interp(at, said, level) + jnp.minimum(at - said[0], 0.0))
        return jnp.where(threat > 0, jnp.maximum(threat, raised), threat)

    @property
    def points(self) -> list[list[float]]:
        """The pairs of what is said and its level, as plain numbers."""
        return np.stack([self.said, self.level], axis=1).astype(float).tolist()


def correction_of(points: Any) -> SumCorrection | None:
    """Returns the correction with given `points`; None for None.

    Args:
        points: pairs, ascending.
    """
    if points is None:
        return None
    said, level = np.asarray(points, float).reshape(-1, 2).T
    return SumCorrection(jnp.asarray(said, float), jnp.asarray(level, float))


class Statement(NamedTuple):
    """A bound that a correction keeps at one level, for states like those of the calibration."""

    level: float  # of true threat
    rate: float  # bound of the share, among states with an action above the level, that are missed
    confidence: float  # with which all bounds hold at once
    states: int  # with an action above the level
    missed: int  # that still have one called at most the level


def calibrated_sum(
    said: Any, true: Any, rate: float, confidence: float = 0.95
) -> tuple[SumCorrection, list[Statement]]:
    """Finds the least correction with which few states have a dangerous action called less so.

    At each level, an action is dangerous if its true threat is above it, and a state is missed if
    a dangerous action of it is called at most the level. The correction of a level is an order
    statistic, as in split-conformal prediction: for any model, the share of states that are missed
    is at most `rate`, at all levels at once, provided that the states are independent of each other
    and of the fit. Where there are too few dangerous states to show the rate, none is missed, and
    the statement says which rate that shows.

    Args:
        said: (n, A) sums of a model.
        true: (n, A) sums of accurate labels.
        rate: greatest share of missed states, in (0, 1].
        confidence: with which it is kept at all levels.

    Returns:
        The correction, and a statement for each level at which a state was dangerous.

    Raises:
        ValueError: a number is out of range.
    """
    number("rate", rate, above=0, most=1)
    number("confidence", confidence, above=0, most=0.999999)
    said, true = np.asarray(said, float), np.asarray(true, float)
    each = 1 - (1 - confidence) / len(LEVELS)
    limits, facts = [], []
    for level in LEVELS:
        least = np.where(true > level, said, np.inf).min(axis=1)  # said of dangerous actions
        least = np.sort(least[(true > level).any(axis=1)])
        n = len(least)
        allowed = max(0, statistics.events_allowed(n, rate, each)) if n else 0
        limits.append(min(MARGIN * least[allowed], level) if n > allowed else level)
        if n:
            facts.append((level, n, statistics.upper_bound(allowed, n, each)))
    # Ascending: what is called at most a level is called at most all greater ones.
    for j in reversed(range(len(limits) - 1)):
        limits[j] = min(limits[j], APART * limits[j + 1])
    ascending = np.maximum(limits, LEAST * (1 + np.arange(len(limits))))
    found = SumCorrection(jnp.asarray([*ascending, 1.0], float), jnp.asarray([*LEVELS, 1.0], float))
    called = np.asarray(found(jnp.asarray(said, float)), float)
    statements = [
        Statement(
            level=level,
            rate=bound,
            confidence=confidence,
            states=n,
            missed=int(((true > level) & (called <= level)).any(axis=1).sum()),
        )
        for level, n, bound in facts
    ]
    return found, statements
