"""Sections of the report on a result, and how its verdicts come about."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rp_jax.runs import tables

EXCEEDED, REPRODUCED, MISSED = "exceeded", "reproduced", "not reproduced"
HALF_A_DIGIT = 0.005  # published crash rates have two digits
CLOSE = 0.02  # of the published return, by which a mean may fall short of it


class Table(NamedTuple):
    """Rows with the same columns; cells are shown as they are."""

    title: str
    rows: Sequence[Mapping[str, Any]]


class Claim(NamedTuple):
    """A published claim, and what came of it."""

    claim: str
    paper: str
    ours: str
    verdict: str


class Section(NamedTuple):
    """A result in the report."""

    text: str
    tables: Sequence[Table] = ()
    claims: Sequence[Claim] = ()
    figures: Mapping[str, str] = {}  # captions by file name


def verdict_on_return(row: Mapping[str, Any], published: float) -> str:
    """By the 95 % interval over seeds: exceeded where all of it lies above the published return.

    Reproduced where the mean reaches it, or the interval does and the mean is `CLOSE`: a wide
    interval alone earns nothing. One seed says nothing of others, and so exceeds nothing.
    """
    mean, width = row["return_mean"], row["return_ci95"]
    if mean - width > published and row["seeds"] > 1:
        return EXCEEDED
    close = mean + width >= published and mean >= published - CLOSE * abs(published)
    return REPRODUCED if mean >= published or close else MISSED


def verdict_on_crashes(row: Mapping[str, Any], published: float) -> str:
    """By the method's whole 95 % interval: below the published rate, or not above it, as rounded.

    Of one seed, it is not called below.
    """
    upper = tables.method_interval(row)[1]
    if upper < published - HALF_A_DIGIT and row["seeds"] > 1:
        return EXCEEDED
    return REPRODUCED if upper <= published + HALF_A_DIGIT else MISSED


def verdict_on(row: Mapping[str, Any], published: tuple[float, float]) -> str:
    """On return and crash rate together: not reproduced if one is not, and then which."""
    parts = {
        "return": verdict_on_return(row, published[0]),
        "crashes": verdict_on_crashes(row, published[1]),
    }
    missed = [name for name, verdict in parts.items() if verdict == MISSED]
    if missed:
        return f"{MISSED} ({' and '.join(missed)})"
    better = [name for name, verdict in parts.items() if verdict == EXCEEDED]
    return f"{EXCEEDED} ({' and '.join(better)})" if better else REPRODUCED


def holds(true: bool) -> str:
    """The verdict on a claim that is true or not."""
    return REPRODUCED if true else MISSED
