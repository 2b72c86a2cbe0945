"""Beyond the paper: Jam among 30 and 50 obstacles, for agents that learned among 8."""

from pathlib import Path
from typing import Any

from experiments.figures import words
from experiments.paper import scores
from experiments.paper.section import Section

TITLE = "Crowds: Jam among 30 and 50 obstacles"
VARIANTS = ("N=30", "N=50")
RUNS = scores.RUNS["jam"] | {scores.AHEAD: "jam_ahead_crowds"}


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """A row per kind of RP, number of obstacles and seed."""
    rows = scores.by_kind(sources, RUNS)
    return [row for row in rows if row["variant"] in VARIANTS]


def plot(results: list[dict[str, Any]], folder: Path) -> None:
    """Return and crash rate."""
    from rp_jax.plot import curves

    curves.scores(words.told(scores.summed_up(results)), {}, folder / "scores.png")


def tell(results: list[dict[str, Any]]) -> Section:
    """Nothing of it was published."""
    return Section(
        "The agents and threat functions of table 1; an agent sees the 8 nearest obstacles, the "
        "shield all of them.",
        tables=[scores.table("Crowds", scores.summed_up(results), {})],
        figures={"scores.png": "Returns and crash rates with 95 % intervals."},
    )
