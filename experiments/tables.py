"""The tables of a run: on the terminal, as JSON and as CSV."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments import console
from rp_jax import statistics, storage

COLUMNS = [
    "env",
    "variant",
    "method",
    "seed",
    "episodes",
    "return_mean",
    "return_ci95",
    "uncrashed_return_mean",
    "crashes",
    "crash_rate",
    "crash_upper95",
    "danger_mean",
    "goal_rate",
    "interventions",
    "insecure",
    "seconds_per_100_actions",
    "train_seconds",
]
ABREAST = 3  # cases that fit a terminal side by side


def write(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """table.json, table.csv, and the same on the terminal; summary.json for several seeds."""
    storage.write_json(folder / "table.json", rows)
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    storage.write_bytes(folder / "table.csv", text.getvalue().encode())
    for start in range(0, len(rows), ABREAST):
        _show(rows[start : start + ABREAST])
    if len({row["seed"] for row in rows}) > 1:
        summary = over_seeds(rows)
        storage.write_json(folder / "summary.json", summary)
        shown = [
            {
                "case": row["variant"],
                "return over seeds": earned(row),
                "crashes": crashed(row),
                "% [95 %]": percent(row),
            }
            for row in summary
        ]
        console.table(f"{summary[0]['seeds']} seeds", shown, list(shown[0]))


def _show(rows: Sequence[Mapping[str, Any]]) -> None:
    """One line per column of the table, one column per case."""
    cases = [f"{row['variant']} seed {row['seed']}" for row in rows]
    lines = []
    for name in COLUMNS[4:]:
        cells = {case: console.show(row[name]) for case, row in zip(cases, rows, strict=True)}
        lines.append({"": name, **cells})
    causes = {c: _causes(row["causes"]) for c, row in zip(cases, rows, strict=True)}
    lines.append({"": "what was hit", **causes})
    console.table(f"{rows[0]['env']}: {rows[0]['method']}", lines, ["", *cases])


def _causes(causes: Mapping[str, int]) -> str:
    return ", ".join(f"{kind} {count}" for kind, count in causes.items())


def percent(row: Mapping[str, Any]) -> str:
    """The crash rate and its exact interval, in per cent."""
    low, high = (100 * bound for bound in row["crash_ci95"])
    return f"{100 * row['crash_rate']:.3f} [{low:.3f}, {high:.3f}]"


def earned(row: Mapping[str, Any]) -> str:
    """The return and the half-width of its 95 % interval."""
    return f"{row['return_mean']:.2f} +- {row['return_ci95']:.2f}"


def crashed(row: Mapping[str, Any]) -> str:
    """Crashes of episodes."""
    return f"{row['crashes']:,} of {row['episodes']:,}"


def over_seeds(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Per variant, the mean and interval of the seeds' returns, and all their crashes pooled.

    The interval of returns is that of the mean over seeds; of one seed alone, over its episodes.
    That of the crash rate is of all episodes as if one agent had played them: it is exact for
    these agents together, and does not say how another seed would do.
    """
    found = []
    for variant in dict.fromkeys(row["variant"] for row in rows):
        of = [row for row in rows if row["variant"] == variant]
        mean, width = statistics.mean_interval(np.asarray([row["return_mean"] for row in of]))
        width = width if len(of) > 1 else of[0]["return_ci95"]
        n, k = sum(r["episodes"] for r in of), sum(r["crashes"] for r in of)
        found.append(
            {
                "variant": variant,
                "seeds": len(of),
                "return_mean": mean,
                "return_ci95": width,
                "crashes": k,
                "episodes": n,
                "crash_rate": k / n,
                "crash_ci95": list(statistics.clopper_pearson(k, n)),
                "crash_upper95": statistics.upper_bound(k, n),
            }
        )
    return found


def show_threats(rows: Sequence[Mapping[str, Any]], x: float, truth: str = "fresh labels") -> None:
    """What the threat models' reports say, on the terminal."""
    shown = [
        {
            "hazard": row["hazard"],
            "of": row["of"],
            **{name: row[name] for name in ("mae", "rmse", "bias", "spearman")},
            "unsafe called safe": f"{100 * row['unsafe_called_safe']:.2f} %",
            "safe called unsafe": f"{100 * row['safe_called_unsafe']:.2f} %",
            "states missed": f"{row['states_missed']} of {row['unsafe_states']}",
        }
        for row in rows
    ]
    console.table(f"threat models against {truth} (x = {x:g})", shown, list(shown[0]))
