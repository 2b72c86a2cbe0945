"""Beyond the paper: the threat function of Jam under a second reward, patrol instead of exit."""

from pathlib import Path
from typing import Any

from experiments.figures import words
from experiments.paper import published, scores
from experiments.paper.section import Claim, Section, holds
from rp_jax.runs import tables

LEARNED_ON = published.LEARNED_ON["jam"]
TITLE = "A second reward: patrol instead of exit"


def run(sources: Any, folder: Path) -> dict[str, Any]:
    """Rows per method, variant and seed, and curves."""
    patrol = sources("patrol")
    history = scores.read_lines(patrol / "metrics.jsonl")
    return {
        "rows": scores.read(patrol / "table.json"),
        "history": [{key: row[key] for key in scores.KEPT} for row in history],
    }


def plot(results: dict[str, Any], folder: Path) -> None:
    """Return and crash rate while learning, and after it."""
    from rp_jax.plot import curves

    curves.methods({"Patrol among 8 obstacles": results["history"]}, folder / "learning.png")
    curves.scores(words.told(scores.summed_up(results["rows"])), {}, folder / "scores.png")


def tell(results: dict[str, Any]) -> Section:
    """The third contribution of section 1."""
    found = scores.summed_up(results["rows"])
    of = [row for row in found if row["variant"] == LEARNED_ON]
    (rp,) = (row for row in of if row["method"].startswith("RP"))
    best = max(
        (row for row in of if row["method"].startswith("DQN")), key=lambda row: row["return_mean"]
    )
    claim = Claim(
        f"Section 1, jam {LEARNED_ON}: a learned threat function solves a CMDP with another reward",
        f"crash rate below c = {published.LIMITS['jam']:g}",
        f"{scores.shown(rp)}; best without a shield: {best['return_mean']:.2f}, "
        f"{tables.percent(best)} %",
        holds(
            tables.method_interval(rp)[1] <= published.LIMITS["jam"]
            and scores.less_earned(best, rp)
        ),
    )
    return Section(
        "The agent earns 20 times the way made to one of two corners, 10 on arrival, and then "
        "heads for the other. Threat functions are those of table 1, not learned again.",
        tables=[scores.table("Patrol", found, {})],
        claims=[claim],
        figures={
            "learning.png": "Return and crash rate while learning.",
            "scores.png": "Returns and crash rates after it, with 95 % intervals.",
        },
    )
