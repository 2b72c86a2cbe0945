"""Returns and crash rates of all methods on the variants of a task, beside published ones."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scipy import stats

from experiments.figures import words
from experiments.paper import published
from experiments.paper.section import Claim, Section, Table, holds, verdict_on
from rp_jax.runs import tables

Row = dict[str, Any]
RP, LOST, PLANS, AHEAD = "RP", "RP, lost", "RP, plans", "RP, plans, one step ahead"
RUNS = {  # of each kind of RP
    "circuit": {RP: "circuit", LOST: "circuit_lost", PLANS: "circuit_plans"},
    "jam": {RP: "jam", PLANS: "jam_plans", AHEAD: "jam_ahead"},
    "point_gather": {RP: "point_gather"},
}
LEARNED = {  # of RP, on the task that was learned
    "point_gather": ("point_gather", "point_gather_x01"),
    "circuit": ("circuit",),
    "jam": ("jam",),
}
SEARCHES = {"point_gather": (1, 2), "circuit": (3, 4, 5), "jam": (2, 3)}  # steps of MPC
TABLED = {"circuit": 4, "jam": 3}  # steps of MPC in the paper's tables
KEPT = ("method", "seed", "steps", "episodes", "return_mean", "crashes")  # of learning curves
ERRORS = "Threat models against fresh labels, and sums on states of the task"


def read(path: Path) -> Any:
    """A JSON file."""
    return json.loads(path.read_text())


def read_lines(path: Path) -> list[Row]:
    """A file with a JSON object per line."""
    return [json.loads(line) for line in path.read_text().splitlines()]


def named(rows: Sequence[Row], method: str) -> list[Row]:
    """Returns the same rows, all of one method."""
    return [{**row, "method": method} for row in rows]


def by_kind(sources: Any, runs: Mapping[str, str]) -> list[Row]:
    """One row per kind of RP, variant and seed, of the runs of each kind."""
    return [
        row
        for method, name in runs.items()
        for row in named(read(sources(name) / "table.json"), method)
    ]


def collect(sources: Any, env: str) -> list[Row]:
    """One row per method, published variant and seed: RP, the methods compared with, MPC."""
    rows = by_kind(sources, RUNS[env])
    rows += evaluated(sources, env)
    rows += searched(sources, env, [TABLED[env]])
    return [row for row in rows if row["variant"] in published.SCORES[env]]


def searched(sources: Any, env: str, searches: Sequence[int]) -> list[Row]:
    """One row per number of steps that MPC looks ahead, variant and seed."""
    folders = [sources(f"mpc_{env}_{steps}") for steps in searches]
    return [row for folder in folders for row in read(folder / "table.json")]


def learners(sources: Any, env: str) -> dict[str, Path]:
    """Folders of the runs of each method that RP is compared with, by its name in commands."""
    return {name: sources(f"{name}_{env}") for name in ("dqn", "cpo", "pid")}


def evaluated(sources: Any, env: str) -> list[Row]:
    """One row per method that learns without threats, variant and seed."""
    return [
        row for folder in learners(sources, env).values() for row in read(folder / "compare.json")
    ]


def curves(sources: Any, env: str) -> list[Row]:
    """One row per method that learns without threats, seed and chunk of its learning."""
    return [
        row
        for name, folder in learners(sources, env).items()
        for row in read_lines(folder / name / "metrics.jsonl")
    ]


def repenalised(row: Row, more: float) -> Row:
    """Returns a row of the same episodes, at most one crash each, with `more` taken off per crash.

    The variance follows from that of the returns and the mean return of those without a crash.
    """
    n, p, mean = row["episodes"], row["crash_rate"], row["return_mean"]
    quantile = float(stats.t.ppf(0.975, n - 1))
    variance = n * (row["return_ci95"] / quantile) ** 2
    covariance = (1 - p) * (mean - row["uncrashed_return_mean"]) if p < 1 else 0.0
    variance += (more**2 * p * (1 - p) - 2 * more * covariance) * n / (n - 1)
    width = quantile * math.sqrt(max(variance, 0.0) / n)
    return {**row, "return_mean": mean - more * p, "return_ci95": width}


def summed_up(rows: Sequence[Row]) -> list[Row]:
    """One row per method and variant, over the seeds."""
    found = []
    for method in dict.fromkeys(row["method"] for row in rows):
        of = [row for row in rows if row["method"] == method]
        found += [{"method": method, **row} for row in tables.over_seeds(of)]
    return found


def line(env: str, row: Row) -> Row:
    """A line of a table: what a method's agents do on a task after learning."""
    return {
        "task": env,
        "method": row["method"],
        "seeds": row["seeds"],
        "return": tables.earned(row),
        "crashes": tables.crashed(row),
        **tables.rates(row),
    }


def errors(row: Row) -> Row:
    """A line of a table: how far a threat model is off, by a row of its report."""
    return {
        "hazard": row["hazard"],
        "of": row["of"],
        "mean absolute error": f"{row['mae']:.4f}",
        "bias": f"{row['bias']:+.4f}",
        "unsafe pairs called safe, %": f"{100 * row['unsafe_called_safe']:.2f}",
    }


def shown(row: Row) -> str:
    """Return and crash rate in words."""
    method = tables.method_percent(row)
    told = f"{tables.earned(row)}; {tables.crashed(row)}: {tables.percent(row)} %"
    return f"{told}, of the method {method} %" if method else told


def said(known: published.Score) -> str:
    """A published return and crash rate in words."""
    return f"{known[0]:g} ({100 * known[1]:g} %)"


def table(
    title: str, scores: Sequence[Row], paper: Mapping[str, Mapping[str, published.Score]]
) -> Table:
    """Ours and the paper's (if there are any), a line per variant and method."""
    lines = []
    for variant in dict.fromkeys(row["variant"] for row in scores):
        for row in scores:
            if row["variant"] != variant:
                continue
            line = {
                "variant": variant,
                "method": row["method"],
                "seeds": row["seeds"],
                "return": tables.earned(row),
                "crashes": tables.crashed(row),
                **tables.rates(row),
            }
            if paper:
                known = paper.get(variant, {}).get(_plain(row["method"]))
                line["paper: return (crashes)"] = said(known) if known else ""
            lines.append(line)
    return Table(title, lines)


def released(env: str) -> Table:
    """The paper's released agents, played again."""
    lines = [
        {"variant": variant, "method": method, "return; crashes [95 %]": found}
        for variant, of in published.RELEASED[env].items()
        for method, found in of.items()
    ]
    title = (
        "The paper's released agents, played again in their own code, which is not part of this one"
    )
    return Table(title, lines)


def _plain(method: str) -> str:
    return "RP" if method.startswith("RP") else method


def plot(rows: Sequence[Row], env: str, path: Path) -> None:
    """All methods' returns and crash rates, with the published ones."""
    from rp_jax.plot import curves

    paper = {words.variant(name): of for name, of in published.SCORES[env].items()}
    curves.scores(words.told(summed_up(rows)), paper, path)


def tell(rows: Sequence[Row], env: str, where: str) -> Section:
    """A published table and ours."""
    found, paper = summed_up(rows), published.SCORES[env]
    return Section(
        "Returns are over all episodes, the penalty per crash included. RP: the paper's baseline "
        "policy; RP, plans: plans that brake and evade; one step ahead: where no action is "
        "admissible by the sum over obstacles, learned in Jam among 0 to 8 obstacles; lost, and "
        "plans on Circuit: not told x and y in a tenth of the episodes of learning, and on other "
        "tracks. Diamonds: the paper.",
        tables=[table(where, found, paper), goals(found, env), released(env)],
        claims=entries(found, paper, where) + comparisons(found, paper, where),
        figures={"scores.png": "Returns and crash rates with 95 % intervals."},
    )


def entries(
    scores: Sequence[Row], paper: Mapping[str, Mapping[str, published.Score]], where: str
) -> list[Claim]:
    """On each published entry of RP, by each kind of RP."""
    found = []
    for row in scores:
        known = paper.get(row["variant"], {}).get("RP")
        if known and row["method"].startswith("RP"):
            claim = f"{where}, {row['variant']}: {row['method']}"
            found.append(Claim(claim, said(known), shown(row), verdict_on(row, known)))
    return found


def comparisons(
    scores: Sequence[Row], paper: Mapping[str, Mapping[str, published.Score]], where: str
) -> list[Claim]:
    """RP is safer than each other method everywhere; penalised DQN fails where it did not learn."""
    rp = {row["variant"]: row for row in scores if row["method"] == RP}
    found = []
    for kind in ("DQN", "MPC"):
        others = [  # where it is so in the paper
            row
            for row in scores
            if row["method"].startswith(kind)
            and paper[row["variant"]].get(row["method"], (0.0, 0.0))[1]
            > paper[row["variant"]]["RP"][1]
        ]
        if not others:
            continue
        ours = {variant: tables.method_interval(row) for variant, row in rp.items()}
        safer = [tables.method_interval(row)[0] > ours[row["variant"]][1] for row in others]
        least = min(others, key=lambda row: row["crash_rate"])
        found.append(
            Claim(
                f"{where}: RP is safer than {kind}",
                "lower crash rate",
                f"below {sum(safer)} of {len(safer)} {kind} entries, intervals apart; the lowest: "
                f"{least['method']}, {least['variant']}: {tables.percent(least)} %",
                holds(all(safer)),
            )
        )
        if kind == "DQN":
            less = [row for row in others if less_earned(row, rp[row["variant"]])]
            best = max(others, key=lambda r: r["return_mean"] - rp[r["variant"]]["return_mean"])
            found.append(
                Claim(
                    f"{where}: RP earns more than DQN",
                    "higher return",
                    f"more than {len(less)} of {len(others)} DQN entries, intervals apart; next: "
                    f"{best['method']}, {best['variant']}: {best['return_mean']:.2f}",
                    holds(len(less) == len(others)),
                )
            )
    return found


def less_earned(one: Row, other: Row) -> bool:
    """Whether one return is below another, their 95 % intervals apart."""
    high = one["return_mean"] + one["return_ci95"]
    return high < other["return_mean"] - other["return_ci95"]


def goals(scores: Sequence[Row], env: str) -> Table:
    """Returns a table of goals: the paper's return, and a bound on the crash rate."""
    lines = []
    for row in scores:
        variant = row["variant"]
        if not row["method"].startswith("RP") or variant not in published.GOALS[env]:
            continue
        bound, wanted = published.GOALS[env][variant], published.SCORES[env][variant]["RP"][0]
        upper = row["method_crash_upper95"] or row["crash_upper95"]
        mean = row["return_mean"]
        lines.append(
            {
                "variant": variant,
                "method": row["method"],
                "return, at least": f"{wanted:g}",
                "reached": f"{mean:.2f}",
                "crash bound, below %": f"{100 * bound:g}",
                "reached, %": f"{100 * upper:.3f}",
                "met": _met(mean - wanted, bound - upper),
            }
        )
    title = "Goals: return, and one-sided 95 % upper bound of the method's crash rate"
    return Table(title, lines)


def _met(more_return: float, less_crashes: float) -> str:
    missed = []
    if more_return < 0:
        missed.append(f"return by {-more_return:.2f}")
    if less_crashes <= 0:
        missed.append(f"crash bound by {-100 * less_crashes:.3f} %")
    return "missed: " + ", ".join(missed) if missed else "yes"
