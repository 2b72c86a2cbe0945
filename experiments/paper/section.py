"""What a result says in the report, and how a verdict comes about."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

EXCEEDED, REPRODUCED, MISSED = "exceeded", "reproduced", "not reproduced"
HALF_A_DIGIT = 0.005  # published crash rates have two digits


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
    """Exceeded where the whole 95 % interval lies above; reproduced where it reaches so far."""
    mean, width = row["return_mean"], row["return_ci95"]
    if mean - width > published:
        return EXCEEDED
    return REPRODUCED if mean + width >= published else MISSED


def verdict_on_crashes(row: Mapping[str, Any], published: float) -> str:
    """By the whole 95 % interval: below the published rate, or not above it, as rounded."""
    upper = row["crash_ci95"][1]
    if upper < published - HALF_A_DIGIT:
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
