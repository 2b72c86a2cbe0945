"""Promised danger against danger met: agents that are told c, over threat functions and seeds."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jax import Array

from rp_jax import statistics, storage
from rp_jax.envs.contract import Env
from rp_jax.planning.loop import LoopConfig
from rp_jax.runs import record, tables
from rp_jax.runs.agents import Agents
from rp_jax.runs.evaluate import evaluate
from rp_jax.runs.plan import plan
from rp_jax.runs.progress import OnProgress, silent
from rp_jax.runs.reconnoitre import reconnoitre
from rp_jax.streams import Stream, key_of, numbered
from rp_jax.threat.build import ThreatConfig
from rp_jax.validate import number

LEARNING = "while learning"  # the episodes of learning, as a variant


def promises(
    key: Array,
    env: Env,
    params: Any,
    *,
    c: Sequence[float],
    x: float,
    tests: Mapping[str, Any],
    threats: int = 3,
    seeds: int = 3,
    threat_config: ThreatConfig | Mapping[str, ThreatConfig] | None = None,
    config: LoopConfig | None = None,
    lookahead: int = 0,
    refunds: int = 8,
    learning_penalty: float = 0.0,
    learning_penalty_from: float | None = None,
    episodes: int = 10_000,
    penalty: float = 0.0,
    folder: Path | None = None,
    devices: str = "one",
    on_progress: OnProgress = silent,
) -> list[dict[str, Any]]:
    """Learns agents that carry budgets, promises them each c, and says what danger there was.

    For each of several threat functions, learned apart, agents learn with c drawn from the range.
    Then each is promised each c in each test.

    Args:
        key: of everything random in it.
        env: the world.
        params: its parameters while learning.
        c: dangers of an episode, ascending.
        x: threat near which the threat functions are learned most closely.
        tests: by name, parameters while testing.
        threats: how many threat functions.
        seeds: how many agents for each.
        threat_config: as `reconnoitre` takes it.
        config: of the learner.
        lookahead: as in `plan`, like `refunds` and the penalties.
        refunds: outcomes by which the danger of a chosen action is booked.
        learning_penalty: taken off the reward per unit of danger while learning.
        learning_penalty_from: what it begins with.
        episodes: of each agent, test and c.
        penalty: taken off the returns per unit of danger.
        folder: for threat functions, agents and tables; the same call goes on where it stopped.
        devices: "one", "all" or "cluster".
        on_progress: called with (stage, done, total, note).

    Returns:
        A row for each test and c, and one for learning: as `tables.over_seeds`, with `promised`,
        and the danger of an episode by counting and by the agents' own account.

    Raises:
        ValueError: a setting is out of range.
    """
    check_promises(c)
    number("threats", threats, least=1, most=1000, integer=True)
    found, learned = [], []
    for i, own in enumerate(numbered(key_of(key, Stream.THREAT), list(range(threats)))):
        place = None if folder is None else folder / f"threat_{i}"
        tell = _named(on_progress, f"threat function {i + 1} of {threats}")
        threat = reconnoitre(
            own,
            env,
            params,
            x=x,
            config=threat_config,
            folder=None if place is None else place / "threat",
            devices=devices,
            on_progress=tell,
        )
        agents = plan(
            own,
            env,
            params,
            threat,
            c=(c[0], c[-1]),
            seeds=seeds,
            config=config,
            lookahead=lookahead,
            refunds=refunds,
            learning_penalty=learning_penalty,
            learning_penalty_from=learning_penalty_from,
            penalty=penalty,
            folder=place,
            devices=devices,
            on_progress=tell,
        )
        learned += while_learning(agents, threat.checksum[:12])
        common: dict[str, Any] = {"episodes": episodes, "penalty": penalty, "devices": devices}
        for name, given in tests.items():
            for promised in c:
                label = f"{name} c={promised:g}"
                file = None if place is None else place / f"{label}.json"
                rows: Any = None if file is None or not file.exists() else record.read_json(file)
                if rows is None:
                    rows = evaluate(
                        *(own, agents, env, given),
                        c=promised,
                        name=label,
                        on_progress=tell,
                        **common,
                    ).rows
                    if file is not None:
                        storage.write_json(file, rows)
                found += [{**row, "variant": name, "promised": promised} for row in rows]
    return [*summed_up(found), *summed_up(learned)]


def check_promises(c: Sequence[float]) -> None:
    """Raises ValueError unless dangers ascend from above 0.

    Args:
        c: dangers of an episode.

    Raises:
        ValueError: there are none, or they do not ascend.
    """
    for value in c:
        number("c", value, above=0)
    if not c or any(b <= a for a, b in itertools.pairwise(c)):
        raise ValueError(f"c is {tuple(c)}; it must hold ascending dangers")


def _named(on_progress: OnProgress, name: str) -> OnProgress:
    return lambda stage, *facts: on_progress(f"{name}: {stage}", *facts)


def while_learning(agents: Agents, threat: str) -> list[dict[str, Any]]:
    """Returns a row per agent of the episodes that it learned in.

    Args:
        agents: that carried budgets.
        threat: name of their threat function.
    """
    low, high = agents.promised or (float("nan"), float("nan"))
    # The mean of a number whose logarithm is uniform.
    promised = low if low == high else (high - low) / np.log(high / low)
    found = []
    for member in agents.members:
        of = [row for row in agents.history if row["seed"] == member.seed]
        sums = {name: sum(row[name] for row in of) for name in ("episodes", "crashes")}
        returns = [row["return_mean"] for row in of if row["episodes"]]
        danger = sum(row["danger"] for row in of) if "danger" in of[0] else sums["crashes"]
        found.append(
            {
                "variant": LEARNING,
                "promised": float(promised),
                "seed": member.seed,
                "threat": threat,
                "return_mean": float(np.mean(returns)) if returns else float("nan"),
                "return_ci95": float("nan"),
                "danger_mean": danger / max(1, sums["episodes"]),
                "booked_mean": float("nan"),
                **sums,
            }
        )
    return found


def summed_up(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns a row for each test and c, over threat functions and seeds.

    Args:
        rows: one for each agent, test and c.
    """
    groups: dict[tuple, list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["variant"], row["promised"]), []).append(row)
    found = []
    for (_, promised), of in groups.items():
        (summary,) = tables.over_seeds(of)
        clusters = tables.clusters_of(of)
        clusters = clusters if len(clusters) > 1 else [[row] for row in of]
        means = {
            name: [float(np.mean([row[name] for row in cluster])) for cluster in clusters]
            for name in ("danger_mean", "booked_mean")
        }
        danger, width = statistics.mean_interval(np.asarray(means["danger_mean"]))
        found.append(
            {
                **summary,
                "promised": promised,
                "danger_mean": danger,
                "danger_ci95": width,
                "booked_mean": float(np.mean(means["booked_mean"])),
                "insecure": float(np.mean([row.get("insecure", np.nan) for row in of])),
                "interventions": float(np.mean([row.get("interventions", np.nan) for row in of])),
            }
        )
    return found
