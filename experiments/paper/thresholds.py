"""Beyond the paper: the frontier of return and crash rate over x, from one threat function."""

from pathlib import Path
from typing import Any

from scipy import stats

from experiments.figures import words
from experiments.paper.scores import read
from experiments.paper.section import Claim, Section, Table, holds
from rp_jax.runs import tables

LEVEL = 0.05  # of the test that fewer states are without an admissible action as x grows
TITLE = "The threshold x, without learning the threat again"


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """A row per planner, variant and threshold, over the seeds."""
    return read(sources("frontier") / "frontier.json")


def plot(results: list[dict[str, Any]], folder: Path) -> None:
    """Return and crash rate over x."""
    from rp_jax.plot import curves

    curves.frontier(words.told(results), folder / "frontier.png")


def tell(results: list[dict[str, Any]]) -> Section:
    """That x needs no new threat function, and what it trades."""
    claims = []
    for variant in dict.fromkeys(row["variant"] for row in results):
        of = [r for r in results if (r["variant"], r["planner"]) == (variant, "separate")]
        least, most = (f(of, key=lambda row: row["x"]) for f in (min, max))
        pairs = [(row["x"], row["insecure"]) for row in of]
        falls = stats.spearmanr(*zip(*pairs, strict=True), alternative="less")
        claims.append(
            Claim(
                f"Section 5.3, jam {variant}: raising x widens what is allowed, without "
                "learning the threat again",
                "wider",
                f"states without an admissible action: {100 * least['insecure']:.2f} % at "
                f"x = {least['x']:g}, {100 * most['insecure']:.2f} % at x = {most['x']:g} (rank "
                f"correlation {falls.statistic:.2f} over {len(of)} thresholds, p = "
                f"{falls.pvalue:.2g}); return {least['return_mean']:.2f} and "
                f"{most['return_mean']:.2f}",
                holds(falls.pvalue < LEVEL),
            )
        )
    lines = [
        {
            "variant": row["variant"],
            "planner": row["planner"],
            "x": f"{row['x']:g}",
            "seeds": row["seeds"],
            "return": tables.earned(row),
            **tables.rates(row),
            "insecure states, %": f"{100 * row['insecure']:.2f}",
        }
        for row in results
    ]
    return Section(
        "Planners for each x, trained side by side, and one planner that is told x; baseline "
        "policy: plans. In one state a greater x forbids less; but planners that may do more go "
        "where more is dangerous, and the states are those that they visit.",
        tables=[Table("Return and crash rate over x", lines)],
        claims=claims,
        figures={"frontier.png": "Return and crash rate over the threshold."},
    )
