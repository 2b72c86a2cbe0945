"""Beyond the paper: one switch at a time, against RP on Jam as in table 1."""

from collections import Counter
from pathlib import Path
from typing import Any

from experiments.figures import words
from experiments.paper import published, scores
from experiments.paper.section import Section
from rp_jax.runs import ablation

TITLE = "Ablations: one switch each"
SWITCHES = {  # by run
    "jam": "as in table 1",
    "unmasked": "target over all actions",
    "plans": "baseline: plans, walls jointly",
    "sampled_walls": "walls: sampled labels",
    "few_states": "obstacles: few states, many paths",
    "uniform": "obstacles: uniform sampling",
    "horizon_5": "obstacles: horizon 5",
    "horizon_12": "obstacles: horizon 12",
}


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """A row per switch, number of obstacles and seed."""
    rows = []
    for name, switch in SWITCHES.items():
        rows += scores.named(scores.read(sources(name) / "table.json"), switch)
    return [row for row in rows if row["variant"] in published.SCORES["jam"]]


def plot(results: list[dict[str, Any]], folder: Path) -> None:
    """Return and crash rate of each."""
    from rp_jax.plot import curves

    curves.scores(words.told(scores.summed_up(results)), {}, folder / "scores.png")


def hit(rows: list[dict[str, Any]]) -> str:
    """Returns what crashed into what, in words: all seeds of a switch and number of obstacles."""
    counts: Counter[str] = Counter()
    for row in rows:
        counts.update(row["collisions"] if "collisions" in row else row["causes"])  # as once named
    return ablation.hits(counts)


def tell(results: list[dict[str, Any]]) -> Section:
    """Returns the section on what each switch costs or gains."""
    table = scores.table("Ablations", scores.summed_up(results), {})
    lines = []
    for line in table.rows:
        place = (line["method"], line["variant"])
        of = [row for row in results if (row["method"], row["variant"]) == place]
        lines.append({**line, "what was hit": hit(of)})
    return Section(
        "Table 1's RP: horizon 8, target over admissible actions (Algorithm 4), the paper's "
        "baseline policy, exact labels for walls, preferential sampling for obstacles, many "
        "states with few paths. The released code takes its target over all actions. The paper's "
        "recipe, and walls summed or jointly, have sections of their own.",
        tables=[table._replace(rows=lines)],
        figures={"scores.png": "Returns and crash rates with 95 % intervals."},
    )
