"""Beyond the paper: the learners that RP is compared with, with many more steps."""

from pathlib import Path
from typing import Any

from experiments.paper import published, scores
from experiments.paper.section import Section, Table

TITLE = "More steps for the others"


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """A row per task, method and number of steps, over the seeds; RP with its own steps alone."""
    rows = []
    for env, runs in scores.LEARNED.items():
        found = [row for name in runs for row in scores.read(sources(name) / "table.json")]
        few = scores.evaluated(sources, env)
        many = scores.evaluated(lambda name: sources(f"long_{name}"), env)
        times = many[0]["training_steps"] / few[0]["training_steps"]
        for budget, of in (("as RP", found + few), (f"{times:.1f} times as many", many)):
            here = [row for row in of if row["variant"] == published.LEARNED_ON[env]]
            rows += [{"env": env, "budget": budget, **row} for row in scores.summed_up(here)]
    return rows


def tell(results: list[dict[str, Any]]) -> Section:
    """Nothing of it was published."""
    lines = [{**scores.line(row["env"], row), "steps": row["budget"]} for row in results]
    return Section(
        "Whether those without a threat function catch up if they may learn for longer; RP's steps "
        "do not count those of the simulators that its threat functions come from.",
        tables=[Table("After learning, on the task that was learned", lines)],
    )
