"""Tables 3 and 4: the episodes of tables 2 and 1 with heavier penalties for crashes."""

from pathlib import Path
from typing import Any

from experiments.paper import published, scores
from experiments.paper.section import Section

TITLE = "Tables 3 and 4: heavier penalties"
TABLES = {"circuit": ("Table 3", 200.0), "jam": ("Table 4", 50.0)}


def run(sources: Any, folder: Path) -> dict[str, Any]:
    """By task, the rows of its table at 1500 (Circuit) and 500 (Jam) per crash."""
    return {
        env: [
            scores.repenalised(row, published.HEAVIER[env] - penalty)
            for row in scores.collect(sources, env)
        ]
        for env, (_, penalty) in TABLES.items()
    }


def tell(results: dict[str, Any]) -> Section:
    """Ours beside the paper's."""
    tables, claims = [], []
    for env, (name, _) in TABLES.items():
        found, paper = scores.summed_up(results[env]), published.HEAVIER_SCORES[env]
        title = f"{name}: {published.HEAVIER[env]:g} per crash"
        tables.append(scores.table(title, found, paper))
        claims += scores.entries(found, paper, name)
    return Section(
        "The same agents and episodes: the paper's tables 3 and 4 follow from its tables 2 and 1 "
        "in the same way, each return less the difference of penalties times the crash rate.",
        tables=tables,
        claims=claims,
    )
