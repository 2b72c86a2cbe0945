"""Crashes while learning: all methods, all tasks."""

from pathlib import Path
from typing import Any

from experiments import tables
from experiments.paper import published, scores
from experiments.paper.fig5 import LEARNERS
from experiments.paper.section import Claim, Section, Table, holds
from rp_jax import statistics

TITLE = "Crashes while learning"


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """A row per task and method: episodes and crashes of all seeds, exploration included."""
    rows = []
    for env, own in scores.RUNS.items():
        files = {method: sources(name) / "metrics.jsonl" for method, name in own.items()}
        histories = {method: scores.read_lines(file) for method, file in files.items()}
        compared = sources(f"compare_{env}")
        for name in LEARNERS:
            for row in scores.read_lines(compared / name / "metrics.jsonl"):
                histories.setdefault(row["method"], []).append(row)
        for method, history in histories.items():
            episodes, crashes, inadmissible = (
                sum(row.get(key, 0) for row in history)
                for key in ("episodes", "crashes", "inadmissible")
            )
            rows.append(
                {
                    "env": env,
                    "method": method,
                    "seeds": len({row["seed"] for row in history}),
                    "episodes": episodes,
                    "crashes": crashes,
                    "crash_rate": crashes / max(1, episodes),
                    "crash_ci95": statistics.clopper_pearson(crashes, max(1, episodes)),
                    "inadmissible": inadmissible if method.startswith("RP") else None,
                }
            )
    return rows


def tell(results: list[dict[str, Any]]) -> Section:
    """That learning in the P-MDP is safe."""
    lines = [
        {
            "task": row["env"],
            "method": row["method"],
            "seeds": row["seeds"],
            "crashes": f"{row['crashes']:,} in {row['episodes']:,} episodes",
            "rate, % [95 %]": tables.percent(row),
            "inadmissible actions": "" if row["inadmissible"] is None else row["inadmissible"],
        }
        for row in results
    ]
    claims = [
        Claim(
            f"Section 1, {row['env']}, {row['method']}: the learning process is safe",
            f"crash rate below c = {published.LIMITS[row['env']]:g}",
            f"{row['crashes']:,} crashes in {row['episodes']:,} episodes: {tables.percent(row)} %",
            holds(row["crash_ci95"][1] <= published.LIMITS[row["env"]]),
        )
        for row in results
        if row["method"].startswith("RP")
    ]
    return Section(
        "From the first step on, exploration included. On Point Gather a crash is an episode with "
        "a bomb.",
        tables=[Table("Crashes while learning", lines)],
        claims=claims,
    )
