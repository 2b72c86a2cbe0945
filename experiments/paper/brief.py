"""Beyond the paper: threat functions and ten agents of both tasks, in minutes."""

from pathlib import Path
from typing import Any

from experiments.figures import words
from experiments.paper import published, scores
from experiments.paper.section import Section, Table

TITLE = "As many steps as the paper's returns need"
RUNS = {"circuit": "circuit_brief", "jam": "jam_brief"}
PARTS = ("reconnaissance", "planning_compilation", "planning")
MINUTES = 8.0  # this project's goal


def run(sources: Any, folder: Path) -> dict[str, Any]:
    """By task, rows per track or number of obstacles and seed; how long learning took."""
    found = {}
    for env, name in RUNS.items():
        made = sources(name)
        rows = scores.named(scores.read(made / "table.json"), scores.RP)
        found[env] = {"rows": rows, **scores.read(made / "training.json")}
    return found


def tell(results: dict[str, Any]) -> Section:
    """Returns and crash rates beside the published ones, and the time against the goal."""
    tables, lines, minutes = [], [], 0.0
    for env, of in results.items():
        rows = [row for row in of["rows"] if row["variant"] in published.SCORES[env]]
        tables.append(scores.table(words.TASKS[env], scores.summed_up(rows), published.SCORES[env]))
        took = {part: of["seconds"][part] / 60 for part in PARTS}
        minutes += sum(took.values())
        line = {"task": env, "seeds": len({row["seed"] for row in rows})}
        line |= {"steps of all": f"{of['steps']:,}"}
        line |= {f"{part.replace('_', ', ')}, minutes": f"{took[part]:.1f}" for part in PARTS}
        lines.append(line)
    if any(of.get("resumed", False) for of in results.values()):
        reached = "how long was not measured: a run was resumed"
    else:
        met = "" if minutes <= MINUTES else f", {minutes - MINUTES:.1f} more than wanted"
        reached = f"together {minutes:.1f} minutes{met}"
    return Section(
        f"Wanted were threat functions and ten seeds of both tasks within {MINUTES:g} minutes; "
        f"{reached}. Circuit under plans, whose threat of walls needs no learning; with 32 "
        "environments side by side.",
        tables=[*tables, Table("Learning, wall time", lines)],
    )
