"""Table 2: agents trained on one track, tested on it narrowed and on a circle (Circuit)."""

from pathlib import Path
from typing import Any

from experiments.paper import scores
from experiments.paper.section import Section

TITLE = "Table 2: Circuit, narrowed, and circle"
ENV = "circuit"


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """A row per method, track and seed."""
    return scores.collect(sources, ENV)


def plot(results: list[dict[str, Any]], folder: Path) -> None:
    """Return and crash rate by method, with published ones."""
    scores.plot(results, ENV, folder / "scores.png")


def tell(results: list[dict[str, Any]]) -> Section:
    """Ours beside the paper's."""
    return scores.tell(results, ENV, "Table 2")
