"""Danger while learning: all methods, all tasks."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.paper import published, scores
from experiments.paper.section import Claim, Section, Table, holds
from rp_jax import statistics
from rp_jax.runs import tables

TITLE = "Crashes while learning"
ALSO = {"point_gather": {"RP, x = .1": "point_gather_x01"}}  # kinds of RP, beside those of tables
GOES_ON = ("point_gather",)  # after a hit, so that an episode's danger may exceed 1


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """A row per task and method: episodes and crashes of all seeds, exploration included."""
    rows = []
    for env, own in scores.RUNS.items():
        own = own | ALSO.get(env, {})
        files = {method: sources(name) / "metrics.jsonl" for method, name in own.items()}
        histories = {method: scores.read_lines(file) for method, file in files.items()}
        for row in scores.curves(sources, env):
            histories.setdefault(row["method"], []).append(row)
        for method, history in histories.items():
            episodes, crashes, inadmissible = (
                sum(row.get(key, 0) for row in history)
                for key in ("episodes", "crashes", "inadmissible")
            )
            # Where a crash ends the episode, crashes are its danger.
            met: list[float] = [row["danger" if "danger" in row else "crashes"] for row in history]
            rows.append(
                {
                    "env": env,
                    "method": method,
                    "seeds": len({row["seed"] for row in history}),
                    "episodes": episodes,
                    "crashes": crashes,
                    "danger": sum(met) / max(1, episodes),
                    "crash_rate": crashes / max(1, episodes),
                    "crash_ci95": statistics.clopper_pearson(crashes, max(1, episodes)),
                    "method_crash_ci95": _over_seeds(history),
                    "inadmissible": inadmissible if method.startswith("RP") else None,
                }
            )
    return rows


def _over_seeds(history: Sequence[Mapping[str, Any]]) -> tuple[float, float] | None:
    """Returns the interval of the method's crash rate while learning; None of one seed."""
    of = [[row for row in history if row["seed"] == s] for s in {row["seed"] for row in history}]
    crashes, episodes = (
        [sum(row.get(name, 0) for row in rows) for rows in of] for name in ("crashes", "episodes")
    )
    if len(of) == 1 or min(episodes) == 0:
        return None
    return statistics.cluster_interval(crashes, episodes)


def tell(results: list[dict[str, Any]]) -> Section:
    """That learning in the P-MDP is safe."""
    lines = [
        {
            "task": row["env"],
            "method": row["method"],
            "seeds": row["seeds"],
            "crashes": f"{row['crashes']:,} in {row['episodes']:,} episodes",
            **tables.rates(row),
            "danger an episode": f"{row['danger']:.2g}",
            "inadmissible actions": "" if row["inadmissible"] is None else row["inadmissible"],
        }
        for row in results
    ]
    claims = [
        Claim(
            f"Section 1, {row['env']}, {row['method']}: the learning process is safe",
            f"danger of an episode below c = {published.LIMITS[row['env']]:g}",
            f"{row['danger']:.2g}; crashes in {tables.crashed(row)} episodes: "
            f"{tables.percent(row)} %, of the method {tables.method_percent(row)} %",
            holds(_keeps(row)),
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


def _keeps(row: dict[str, Any]) -> bool:
    """Whether c is kept: by the whole interval, or, where danger is no probability, the mean."""
    found = row["danger"] if row["env"] in GOES_ON else tables.method_interval(row)[1]
    return bool(found <= published.LIMITS[row["env"]])
