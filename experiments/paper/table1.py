"""Table 1: agents trained among 8 obstacles, tested among 3, 8 and 15 (Jam)."""

from pathlib import Path
from typing import Any

from experiments.paper import published, scores
from experiments.paper.section import Section

TITLE = "Table 1: Jam among 3, 8 and 15 obstacles"
ENV, SEARCHES = "jam", (3,)


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """A row per method, number of obstacles and seed."""
    rows = scores.collect(sources, ENV, SEARCHES)
    return [row for row in rows if row["variant"] in published.SCORES[ENV]]


def plot(results: list[dict[str, Any]], folder: Path) -> None:
    """Return and crash rate by method, with published ones."""
    scores.plot(results, ENV, folder / "scores.png")


def tell(results: list[dict[str, Any]]) -> Section:
    """Ours beside the paper's."""
    return scores.tell(results, ENV, "Table 1")
