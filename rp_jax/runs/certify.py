"""Certificates: whether an agent's crash rate is at most a given one, settled by a planned test."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array

from rp_jax import evaluation, statistics
from rp_jax.envs.contract import Env
from rp_jax.runs import record
from rp_jax.runs.agents import Agents
from rp_jax.runs.evaluate import ROUND, checked_agents, greedily, spec_of
from rp_jax.runs.progress import OnProgress, silent
from rp_jax.streams import Stream, key_of
from rp_jax.validate import number, path, random_key

POWER = 0.9  # of the test, at the expected crash rate


@dataclass(frozen=True)
class Certificate:
    """Result of testing whether an agent's crash rate is at most c."""

    env: str
    method: str
    c: float  # crash rate not to be exceeded
    confidence: float  # of the statement
    planned_episodes: int
    allowed_crashes: int  # so many in the planned episodes still show it
    episodes: int  # played
    crashes: int
    upper_bound: float | None  # of the rate; None after too many crashes, when the test ends early

    @property
    def shown(self) -> bool:
        """Whether the crash rate was shown to be at most c."""
        return self.crashes <= self.allowed_crashes

    def __str__(self) -> str:
        counts = f"{self.crashes} crashes in {self.episodes:,} episodes"
        level = f"{100 * self.confidence:g} % confidence"
        if self.shown:
            return (
                f"SHOWN: {self.env}, {self.method}: crash rate at most {self.c:g} per episode at "
                f"{level} ({counts}; bound {self.upper_bound:.3g})"
            )
        return (
            f"NOT SHOWN: {self.env}, {self.method}: a crash rate of at most {self.c:g} per episode "
            f"at {level} ({counts}; {self.allowed_crashes} in {self.planned_episodes:,} were "
            "allowed)"
        )


def certify(
    key: Array,
    agents: Agents,
    env: Env | None = None,
    params: Any = None,
    *,
    c: float,
    confidence: float = 0.99,
    expected: float | None = None,
    agent: int = 0,
    folder: str | Path | None = None,
    on_plan: Callable[[int, int], None] | None = None,
    on_progress: OnProgress = silent,
) -> Certificate:
    """Tests whether an agent's crash rate is at most c.

    How many episodes it takes, and how many crashes are allowed, is settled before any is played.

    Args:
        key: of the episodes; they never share a draw with learning or evaluation.
        agents: as `plan` or `load` returns them.
        env: the world; by default that of the agents.
        params: its parameters; by default those that were learned with.
        c: crash rate not to be exceeded.
        confidence: of the statement.
        expected: crash rate that shall pass with a probability of 90 %; half of c by default.
        agent: which of them, counted from 0.
        folder: where checkpoints are kept meanwhile; the same call goes on after an interruption.
        on_plan: called with (episodes, crashes allowed) before any is played.
        on_progress: called with (stage, done, total, note).

    Raises:
        ValueError: a number is out of range, or the agents cannot act in this world.
        FloatingPointError: an observation, a threat or a reward is not a finite number.
    """
    random_key("key", key)
    where = None if folder is None else path("folder", folder)
    number("c", c, above=0)
    checked_agents(agents)
    number("agent", agent, least=0, most=len(agents) - 1, integer=True)
    n, allowed = statistics.plan_test(c, confidence, c / 2 if expected is None else expected, POWER)
    alone = agents.in_world(env, params)[agent : agent + 1]
    subject = alone[0]
    pmdp = subject.pmdp
    if on_plan is not None:
        on_plan(n, allowed)
    size = min(ROUND, n)

    @jax.jit
    def play(key: Array, weights: Any, pmdp: Any) -> evaluation.Episodes:
        return evaluation.play_round(key, pmdp, greedily(agents.network)(weights), size)

    own, rounds = key_of(key, Stream.CERTIFICATE), -(-n // size)

    def one(i: int, counts: np.ndarray) -> np.ndarray:
        done, crashes = counts
        if crashes > allowed:
            return counts  # it is settled
        found = play(jax.random.fold_in(own, i), subject.weights, pmdp)
        evaluation.check(found, "certify")
        danger = np.asarray(found.danger)[: n - done]
        done, crashes = done + len(danger), crashes + int((danger > 0).sum())
        on_progress("certify", i + 1, rounds, f"{crashes} crashes of {allowed} allowed")
        return np.asarray([done, crashes])

    job = {} if where is None else {**spec_of(key, alone), "episodes": n, "allowed": allowed}
    with record.job(where, "certify", job) as checkpoints:
        done, crashes = map(int, checkpoints.loop(np.zeros(2, int), one, rounds))
    shows = crashes <= allowed
    return Certificate(
        env=record.short_name(pmdp.env),
        method=agents.methods[agent],
        c=c,
        confidence=confidence,
        planned_episodes=n,
        allowed_crashes=allowed,
        episodes=done,
        crashes=crashes,
        # After an early end the crashes are too many by choice: there is no bound to state.
        upper_bound=statistics.upper_bound(crashes, done, confidence) if shows else None,
    )
