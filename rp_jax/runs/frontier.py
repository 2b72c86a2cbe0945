"""The frontier of return and crash rate over the threshold x, from one threat function.

Agents for all thresholds learn side by side in one program; beside them agents that are told x.
Neither learns the threat function again.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jax import Array

from rp_jax.envs.contract import Env
from rp_jax.planning import conditioned
from rp_jax.planning.loop import LoopConfig
from rp_jax.planning.wrapped import ranged
from rp_jax.runs import tables
from rp_jax.runs.evaluate import evaluate
from rp_jax.runs.plan import plan
from rp_jax.runs.progress import OnMetrics, OnProgress, silent
from rp_jax.threat.function import ThreatFunction
from rp_jax.validate import number

SEPARATE, TOLD = "separate", "told x"


def check_thresholds(thresholds: Sequence[float]) -> None:
    """Raises ValueError unless there are two thresholds at least, ascending, from (0, 1].

    Args:
        thresholds: of admissible threat.
    """
    if len(thresholds) < 2 or list(thresholds) != sorted(set(thresholds)):
        raise ValueError(f"thresholds is {tuple(thresholds)}; it must ascend, two at least")
    for x in thresholds:
        number("thresholds", x, above=0, most=1)


def frontier(
    key: Array,
    env: Env,
    params: Any,
    threat: ThreatFunction,
    *,
    thresholds: Sequence[float],
    tests: Mapping[str, Any],
    seeds: int | Sequence[int] = 1,
    config: LoopConfig | None = None,
    lookahead: int = 0,
    learning_penalty: float = 0.0,
    learning_penalty_from: float | None = None,
    insecure_penalty: float = 0.0,
    episodes: int = 10_000,
    penalty: float = 0.0,
    folder: Path | None = None,
    devices: str = "one",
    on_progress: OnProgress = silent,
    on_metrics: OnMetrics = silent,
) -> list[dict[str, Any]]:
    """Learns and evaluates agents for each threshold, and agents that are told the threshold.

    Args:
        key: of learning and evaluation.
        env: the world.
        params: its parameters while learning.
        threat: its threat function.
        thresholds: of admissible threat, ascending.
        tests: by name, parameters while testing.
        seeds: how many agents of each kind, or their numbers.
        config: of the learner.
        lookahead: as in `plan`, like the three penalties of learning.
        learning_penalty: taken off the reward per unit of danger while learning.
        learning_penalty_from: what it begins with.
        insecure_penalty: taken off the reward per state reached in which no action is admissible.
        episodes: evaluated per test and agent.
        penalty: taken off the returns per unit of danger.
        folder: for curves, agents and checkpoints.
        devices: "one", "all" or "cluster".
        on_progress: called with (stage, done, total, note).
        on_metrics: called with a row of facts per chunk and agent.

    Returns:
        One row per kind of agent, test and threshold, over the seeds.

    Raises:
        ValueError: a setting is out of range.
    """
    check_thresholds(thresholds)
    place = lambda name: None if folder is None else Path(folder) / name  # noqa: E731
    common: dict[str, Any] = {
        "seeds": seeds,
        "config": config,
        "lookahead": lookahead,
        "learning_penalty": learning_penalty,
        "learning_penalty_from": learning_penalty_from,
        "insecure_penalty": insecure_penalty,
        "penalty": penalty,
        "devices": devices,
        "on_progress": on_progress,
        "on_metrics": on_metrics,
    }
    judged: dict[str, Any] = {
        "episodes": episodes,
        "penalty": penalty,
        "devices": devices,
        "on_progress": on_progress,
    }
    agents = plan(key, env, params, threat, x=thresholds, folder=place("separate"), **common)
    rows = [
        {"planner": SEPARATE, **row}
        for name, given in tests.items()
        for row in evaluate(key, agents, env, given, name=name, folder=place("separate"), **judged)
    ]
    whole = conditioned.Conditioned(env)
    spread = ranged(params, thresholds[0], thresholds[-1])
    agents = plan(key, whole, spread, threat, x=thresholds[-1], folder=place("told"), **common)
    for name, given in tests.items():
        for x in thresholds:
            fixed = ranged(given, x, x)
            label = f"{name} x={x:g}"
            found = evaluate(key, agents, whole, fixed, name=label, folder=place("told"), **judged)
            rows += [{"planner": TOLD, **row, "variant": name, "x": x} for row in found]
    return over_seeds(rows)


def over_seeds(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns one row per kind of agent, test and threshold, over the seeds.

    Args:
        rows: one per kind, test, threshold and seed.
    """
    groups: dict[tuple, list] = {}
    for row in rows:
        groups.setdefault((row["planner"], row["variant"], row["x"]), []).append(row)
    found = []
    for (planner, variant, x), group in groups.items():
        (summary,) = tables.over_seeds(group)
        insecure = float(np.mean([row["insecure"] for row in group]))
        own = {"planner": planner, **summary, "variant": variant, "x": x, "insecure": insecure}
        found.append(own)
    return found
