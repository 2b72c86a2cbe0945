"""Table 1: agents trained among 8 obstacles, tested among 3, 8 and 15 (Jam)."""

from pathlib import Path
from typing import Any

from experiments.paper import scores
from experiments.paper.section import Section

TITLE = "Table 1: Jam among 3, 8 and 15 obstacles"
ENV = "jam"


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """A row per method, number of obstacles and seed."""
    return scores.collect(sources, ENV)


def plot(results: list[dict[str, Any]], folder: Path) -> None:
    """Return and crash rate by method, with published ones."""
    scores.plot(results, ENV, folder / "scores.png")


def tell(results: list[dict[str, Any]]) -> Section:
    """Ours beside the paper's."""
    return scores.tell(results, ENV, "Table 1")
