"""Figure 5: return and crash rate against steps, on Point Gather, Circuit and Jam."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from experiments.figures import words
from experiments.paper import published, scores
from experiments.paper.section import Claim, Section, Table, holds
from rp_jax import statistics
from rp_jax.runs import tables

TITLE = "Figure 5: learning curves"
ALMOST = 80  # per cent
TENTH = 0.1  # of the steps, over which returns are compared
COMPETITIVE = 0.9  # of the best return that keeps c


def run(sources: Any, folder: Path) -> dict[str, Any]:
    """By task, rows per chunk, method and seed; rows of MPC; what RP and others end with."""
    found: dict[str, Any] = {}
    for env, runs in scores.LEARNED.items():
        variant = published.LEARNED_ON[env]
        files = [sources(name) / "metrics.jsonl" for name in runs]
        history = [row for file in files for row in scores.read_lines(file)]
        history += scores.curves(sources, env)
        rows = [row for name in runs for row in scores.read(sources(name) / "table.json")]
        rows += scores.evaluated(sources, env)
        levels = scores.searched(sources, env, scores.SEARCHES[env])
        found[env] = {
            "history": [{key: row[key] for key in scores.KEPT} for row in history],
            "evaluated": [row for row in rows if row["variant"] == variant],
            "levels": [row for row in levels if row["variant"] == variant],
        }
    gather = sources("point_gather")
    shutil.copyfile(gather / "animation.gif", folder / "animation.gif")
    shutil.copyfile(gather / "figures" / "trajectories.png", folder / "trajectories.png")
    return found


def plot(results: dict[str, Any], folder: Path) -> None:
    """A column per task."""
    from rp_jax.plot import curves

    panels = {words.TASKS[env]: of["history"] for env, of in results.items()}
    levels = {words.TASKS[env]: words.told(of["levels"]) for env, of in results.items()}
    curves.methods(panels, folder / "figure_5.png", levels)


def tell(results: dict[str, Any]) -> Section:
    """The claims of section 5.3."""
    seeds = {row["seed"] for row in results["jam"]["history"]}
    learned = []
    for env, of in results.items():
        for row in scores.summed_up(of["evaluated"] + of["levels"]):
            learned.append(scores.line(env, row))
    rising = [row for env, of in results.items() for row in rise(env, of)]
    claims = [claim for env in ("circuit", "jam") for claim in _ahead(results[env], env)]
    return Section(
        f"{words.counted(len(seeds), 'seed')}; lines are means over seeds, bands 90 % intervals. "
        "Curves show the agents as they explore; the table, the learned agents. MPC does not "
        "learn.",
        tables=[
            Table("After learning, on the task that was learned", learned),
            Table("Whether returns still rise", rising),
        ],
        claims=[*claims, *_gather(results["point_gather"])],
        figures={
            "figure_5.png": "Return and crash rate against agent steps; where few episodes ended, "
            "which are short ones, they are shown together with the next.",
            "trajectories.png": "Point Gather, x = .5: six rooms; apples green, bombs red.",
            "animation.gif": "Point Gather, x = .5: an episode, and the threat of each action.",
        },
    )


def rise(env: str, of: dict[str, Any]) -> list[dict[str, Any]]:
    """Returns lines of a table: returns while exploring, in the last tenth of steps and before."""
    lines = []
    for method in dict.fromkeys(row["method"] for row in of["history"]):
        rows = [row for row in of["history"] if row["method"] == method and row["episodes"]]
        steps = sorted({row["steps"] for row in rows})
        count = max(1, round(TENTH * len(steps)))
        tenths = (steps[-count:], steps[-2 * count : -count])
        late, before = (_by_seed([r for r in rows if r["steps"] in tenth]) for tenth in tenths)
        both = sorted(late.keys() & before.keys())
        if not both:  # no episode ended in one of the two
            continue
        last = float(np.mean([late[seed] for seed in both]))
        changes = np.asarray([late[seed] - before[seed] for seed in both])
        change, width = statistics.mean_interval(changes)
        spread = "" if len(both) == 1 else f" +- {width:.2f}"
        lines.append(
            {
                "task": env,
                "method": method,
                "steps": f"{steps[-1]:,}",
                "last tenth": f"{last:.2f}",
                "change from the tenth before": f"{change:+.2f}{spread}",
                "of the return, %": f"{100 * change / abs(last):+.1f}",
            }
        )
    return lines


def _by_seed(rows: list[dict[str, Any]]) -> dict[int, float]:
    """Mean returns of the episodes of some chunks, by seed."""
    found = {}
    for seed in {row["seed"] for row in rows}:
        of = [row for row in rows if row["seed"] == seed]
        weights = [row["episodes"] for row in of]
        found[seed] = float(np.average([row["return_mean"] for row in of], weights=weights))
    return found


def _by_step(history: list[dict], method: str) -> list[tuple[int, float, float]]:
    """(steps, mean return, crash rate) of each chunk in which episodes ended."""
    of = [row for row in history if row["method"] == method and row["episodes"]]
    found = []
    for steps in sorted({row["steps"] for row in of}):
        group = [row for row in of if row["steps"] == steps]
        returns = sum(row["return_mean"] for row in group) / len(group)
        crashes, episodes = (sum(row[k] for row in group) for k in ("crashes", "episodes"))
        found.append((steps, returns, crashes / episodes))
    return found


def _ahead(of: dict[str, Any], env: str) -> list[Claim]:
    """The highest return and the lowest crash rate in almost all phases; safer than MPC.

    A rival is what a learner last did at no more steps, and each level of MPC.
    """
    methods = list(dict.fromkeys(row["method"] for row in of["history"]))
    (rp,), others = ([m for m in methods if m.startswith("RP") == own] for own in (True, False))
    curves = {method: _by_step(of["history"], method) for method in methods}
    levels = [(0, r["return_mean"], r["crash_rate"]) for r in scores.summed_up(of["levels"])]
    ahead, safer = [], []
    for steps, earned, rate in curves[rp]:
        rivals = [[p for p in curves[m] if p[0] <= steps] for m in others]
        latest = [*levels, *(points[-1] for points in rivals if points)]
        ahead.append(all(earned >= point[1] for point in latest))
        safer.append(all(rate <= point[2] for point in latest))
    final = {row["method"]: row for row in scores.summed_up(of["evaluated"] + of["levels"])}
    three = next((row for name, row in final.items() if name == "MPC (3 steps)"), None)
    highest, lowest = (100 * sum(found) / len(found) for found in (ahead, safer))
    claims = [
        Claim(
            f"Figure 5, {env}: the highest return in almost all phases of training",
            f"almost all ({ALMOST} %)",
            f"{highest:.0f} % of {len(ahead)} points",
            holds(highest >= ALMOST),
        ),
        Claim(
            f"Figure 5, {env}: the lowest crash rate, in almost all phases",
            f"lowest ({ALMOST} %)",
            f"{lowest:.0f} % of {len(safer)} points",
            holds(lowest >= ALMOST),
        ),
    ]
    if three is not None:
        claims.append(
            Claim(
                f"Section 5.3, {env}: safer than 3-step MPC",
                "lower crash rate",
                f"RP {tables.percent(final[rp])} %, MPC {tables.percent(three)} %",
                holds(tables.method_interval(final[rp])[1] < tables.method_interval(three)[0]),
            )
        )
    return claims


def _gather(of: dict[str, Any]) -> list[Claim]:
    """x = .1 earns less than DQN and CPO; x = .5 keeps up, and the constraint."""
    final = {row["method"]: row for row in scores.summed_up(of["evaluated"])}
    danger = {
        method: [row["danger_mean"] for row in of["evaluated"] if row["method"] == method]
        for method in final
    }
    wide, narrow = final["RP (x=0.5)"], final["RP (x=0.1)"]
    limit = published.LIMITS["point_gather"]
    within = [m for m in final if sum(danger[m]) / len(danger[m]) <= limit and m[:2] != "RP"]
    rivals = [
        max((row for m, row in final.items() if m.startswith(kind)), key=lambda r: r["return_mean"])
        for kind in ("DQN", "CPO")
    ]
    safest = max((final[m] for m in within), key=lambda row: row["return_mean"], default=None)
    mean = sum(danger["RP (x=0.5)"]) / len(danger["RP (x=0.5)"])
    rival = f"; best that keeps c: {safest['return_mean']:.2f}" if safest else "; no other keeps c"
    return [
        Claim(
            "Section 5.3, point_gather: x = .1 earns less than penalised DQN and CPO",
            "less",
            f"RP {tables.earned(narrow)}; "
            + "; ".join(f"{row['method']} {tables.earned(row)}" for row in rivals),
            holds(all(scores.less_earned(narrow, row) for row in rivals)),
        ),
        Claim(
            "Section 5.3, point_gather: x = .5 is competitive and keeps c = .1, from the same "
            "threat function",
            f"competitive ({100 * COMPETITIVE:.0f} % of the best that keeps c), danger below .1",
            f"return {tables.earned(wide)}, bombs an episode {mean:.4f}{rival}",
            holds(
                mean <= limit
                and (safest is None or wide["return_mean"] >= COMPETITIVE * safest["return_mean"])
            ),
        ),
    ]
