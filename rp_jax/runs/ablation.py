"""Comparison of one learner without a shield, penalised instead, and with a shield."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
from jax import Array

from rp_jax import evaluation
from rp_jax.envs.contract import Env
from rp_jax.planning.loop import LoopConfig
from rp_jax.planning.percept import Percept
from rp_jax.runs.agents import Agents
from rp_jax.runs.evaluate import evaluate
from rp_jax.runs.plan import make_pmdp, plan
from rp_jax.runs.progress import OnMetrics, OnProgress, silent
from rp_jax.runs.tables import Table, aligned, crashed, earned, hits, over_seeds, rates
from rp_jax.streams import Stream, key_of, numbered
from rp_jax.threat.function import ThreatFunction
from rp_jax.validate import number


@dataclass(frozen=True)
class ShieldTable(Table):
    """Results of several methods, each summed up by itself; `print` shows what was hit."""

    def __str__(self) -> str:
        return aligned(
            [
                {
                    "variant": row["variant"],
                    "method": row["method"],
                    "agent": str(row["seed"]),
                    "return": earned(row),
                    "crashes": crashed(row),
                    **rates(row),
                    "hit": hits(row["collisions"]),
                    "goal": f"{row['goal_rate']:.3f}",
                }
                for row in self.rows
            ]
        )

    @property
    def summary(self) -> list[dict[str, Any]]:
        """One row per method and variant, over the agents: see `over_seeds`."""
        found = []
        for method in dict.fromkeys(row["method"] for row in self.rows):
            of = [row for row in self.rows if row["method"] == method]
            found += [{"method": method, **row} for row in over_seeds(of)]
        return found


def compare_shields(
    key: Array,
    env: Env,
    params: Any,
    threat: ThreatFunction,
    *,
    x: float,
    penalty: float,
    tests: Mapping[str, Any],
    seeds: int | Sequence[int] = 1,
    config: LoopConfig | None = None,
    lookahead: int = 0,
    insecure_penalty: float = 0.0,
    episodes: int = 10_000,
    folder: Path | None = None,
    settings: Mapping[str, Any] | None = None,
    devices: str = "one",
    on_progress: OnProgress = silent,
    on_metrics: OnMetrics = silent,
) -> tuple[list[Agents], ShieldTable]:
    """Compares acting at random and learning: without a shield, penalised, and with the shield.

    Args:
        key: of learning and evaluation.
        env: the world.
        params: its parameters while learning.
        threat: its threat function.
        x: largest admissible threat of the shield; finite.
        penalty: per unit of danger: taken off the returns, and off the reward of the penalised.
        tests: by name, parameters while testing.
        seeds: how many agents of each kind, or their numbers.
        config: of the learner.
        lookahead: of the shield, as in `plan`.
        insecure_penalty: of those that learn behind the shield, as in `plan`.
        episodes: evaluated per test and agent.
        folder: for curves, agents and checkpoints.
        settings: keywords of `env.make_params` that made the parameters.
        devices: "one", "all" or "cluster".
        on_progress: called with (stage, done, total, note).
        on_metrics: called with a row of facts per chunk and agent.

    Returns:
        The agents without and with the shield, and a row per test, method and agent.

    Raises:
        ValueError: a setting is out of range.
    """
    number("x", x, least=0)
    place = lambda name: None if folder is None else Path(folder) / name  # noqa: E731
    common: dict[str, Any] = {
        "seeds": seeds,
        "config": config,
        "penalty": penalty,
        "settings": settings,
        "devices": devices,
        "on_metrics": on_metrics,
    }
    bars = [_named(on_progress, name) for name in ("without shield", "with shield")]
    free = plan(
        key,
        env,
        params,
        learning_penalty=(0.0, penalty),
        folder=place("unshielded"),
        on_progress=bars[0],
        **common,
    )
    held = plan(
        key,
        env,
        params,
        threat,
        x=x,
        lookahead=lookahead,
        insecure_penalty=insecure_penalty,
        folder=folder,
        on_progress=bars[1],
        **common,
    )
    rows: list[dict[str, Any]] = []
    for name, given in tests.items():
        rows += untrained(
            key,
            env,
            given,
            threat,
            x=x,
            lookahead=lookahead,
            seed=held.members[0].seed,
            penalty=penalty,
            episodes=episodes,
            name=name,
            on_progress=_named(on_progress, "at random"),
        )
        for agents, where, bar in zip(
            (free, held), (place("unshielded"), folder), bars, strict=True
        ):
            rows += evaluate(
                key,
                agents,
                env,
                given,
                episodes=episodes,
                penalty=penalty,
                name=name,
                folder=where,
                devices=devices,
                on_progress=bar,
            )
    return [free, held], ShieldTable(rows)


def _named(on_progress: OnProgress, name: str) -> OnProgress:
    """Returns a callback that tells whose each stage is, so that each has a bar of its own."""
    return lambda stage, *rest: on_progress(f"{stage}, {name}", *rest)


def untrained(
    key: Array,
    env: Env,
    params: Any,
    threat: ThreatFunction,
    *,
    x: float,
    penalty: float,
    episodes: int,
    lookahead: int = 0,
    seed: int = 0,
    name: str = "",
    on_progress: OnProgress = silent,
) -> list[dict[str, Any]]:
    """Evaluates acting at random: over all actions alike, and over all admissible actions alike.

    Args:
        key: of the episodes.
        env: the world.
        params: its parameters.
        threat: its threat function.
        x: largest admissible threat of the shield.
        penalty: taken off the returns per unit of danger.
        episodes: of each.
        lookahead: of the shield, as in `plan`.
        seed: number of the episodes, as of an agent.
        name: of the parameters, for the table.
        on_progress: called with (stage, done, total, note).

    Returns:
        Two rows of facts.
    """

    def policy(key: Array, percept: Percept) -> tuple[Array, Array]:
        scores = jax.random.uniform(key, percept.threat.shape)
        return evaluation.shielded(lambda _: scores)(key, percept)

    own = numbered(key_of(key, Stream.UNTRAINED), [seed])[0]
    play = jax.jit(lambda pmdp: evaluation.play_episodes(own, pmdp, policy, episodes))
    rows: list[dict[str, Any]] = []
    stage = f"evaluation {name}".strip()
    cases = {"random": None, f"random, shield (x={x:g})": threat}
    for method, given in cases.items():
        on_progress(stage, len(rows), len(cases), method)
        found = play(make_pmdp(env, params, given, x=x, lookahead=lookahead))
        evaluation.check(found, method)
        shown = {"variant": name, "method": method, "seed": seed}
        shown["x"] = float("inf") if given is None else x
        rows.append({**shown, **evaluation.summarise(found, penalty)})
    on_progress(stage, len(cases), len(cases), "")
    return rows
