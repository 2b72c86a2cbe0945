"""The paper's recipe for RP (appendix G.1) beside the tuned one."""

from pathlib import Path
from typing import Any

from experiments.figures import words
from experiments.paper import published, scores
from experiments.paper.section import Section, Table

TITLE = "The paper's recipe against the tuned one"
TASKS = ("circuit", "jam")
TUNED, PAPER = "RP, tuned", "RP, paper's recipe"


def run(sources: Any, folder: Path) -> dict[str, Any]:
    """By task, rows per recipe, variant and seed; curves of both; how good their threats are."""
    found = {}
    for env in TASKS:
        rows, history, reports = [], [], []
        for method, name in ((TUNED, env), (PAPER, f"{env}_paper")):
            run = sources(name)
            rows += scores.named(scores.read(run / "table.json"), method)
            history += scores.named(scores.read_lines(run / "metrics.jsonl"), method)
            reports += scores.named(scores.read(run / "threat" / "report.json"), method)
        rows = [row for row in rows if row["variant"] in published.SCORES[env]]
        found[env] = {"rows": rows, "history": history, "reports": reports}
    return found


def plot(results: dict[str, Any], folder: Path) -> None:
    """Learning curves of both."""
    from rp_jax.plot import curves

    panels = {words.TASKS[env]: of["history"] for env, of in results.items()}
    curves.methods(panels, folder / "learning.png")


def tell(results: dict[str, Any]) -> Section:
    """Tables 1 and 2 for both recipes."""
    tables, claims, lasted, threats = [], [], [], []
    for env, of in results.items():
        found = scores.summed_up(of["rows"])
        tables.append(scores.table(words.TASKS[env], found, published.SCORES[env]))
        for row in of["reports"]:
            threats.append({"task": env, "recipe": row["method"], **scores.errors(row)})
        theirs = [row for row in found if row["method"] == PAPER]
        claims += scores.entries(theirs, published.SCORES[env], f"Recipe of appendix G.1, {env}")
        last = [row for row in of["history"] if row["method"] == PAPER][-1]
        lasted.append(f"{env}: {last['steps']:,} steps in {last['seconds'] / 3600:.2f} hours")
    return Section(
        "Networks, threat functions, learner and exploration as the paper has them. Planning by "
        f"the paper's recipe: {'; '.join(lasted)}; the paper: 3M steps, 24 hours on a GPU.",
        tables=[*tables, Table(scores.ERRORS, threats)],
        claims=claims,
        figures={"learning.png": "Return and crash rate while learning."},
    )
