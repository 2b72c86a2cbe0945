"""Theorems 1, 2 and 3 and their corollaries, on random CMDPs against the worst policy."""

from pathlib import Path
from typing import Any

from experiments.paper.scores import read
from experiments.paper.section import Claim, Section, Table, holds

TITLE = "Theorems"


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """A row per theorem and horizon."""
    return read(sources("theorems") / "table.json")


def tell(results: list[dict[str, Any]]) -> Section:
    """Violations of each."""
    claims, lines = [], []
    for theorem in dict.fromkeys(row["theorem"] for row in results):
        of = [row for row in results if row["theorem"] == theorem]
        instances, violations = (sum(row[key] for row in of) for key in ("instances", "violations"))
        largest = max(row["largest"] for row in of)
        lines.append(
            {
                "theorem": theorem,
                "instances": f"{instances:,}",
                "violations": f"{violations:,}",
                "largest excess": f"{largest:.1e}",
            }
        )
        said = f"{violations:,} violations in {instances:,} random instances"
        claims.append(Claim(f"Sections 3 and 4: {theorem}", "holds", said, holds(violations == 0)))
    return Section(
        "In double precision; excess is relative to the greatest possible danger, and a violation "
        "is more than 1e-9 of it. Where the text has to be read with care: docs/theory.md.",
        tables=[Table("Random CMDPs against the exact worst policy", lines)],
        claims=claims,
    )
