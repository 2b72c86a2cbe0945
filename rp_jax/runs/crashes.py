"""Crashes as a job: each is looked at step by step, beside the best that could have been done.

In the last states before a crash, and for each action, many episodes go on from the same state: by
that action, and then as the agent does. So the risk of what it chose is seen beside that of the
best it could have chosen, and beside the threat that it chose by. The rest was bad luck.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rp_jax import rare, recording, statistics
from rp_jax.envs import optional
from rp_jax.planning.pmdp import PMDP
from rp_jax.runs.agents import Agent
from rp_jax.runs.evaluate import ROUND
from rp_jax.runs.progress import OnProgress, silent
from rp_jax.streams import Stream, key_of
from rp_jax.validate import finite, number, random_key


@dataclass(frozen=True)
class CrashConfig:
    """How many crashes are looked at, and how closely."""

    episodes: int = 20_000  # among which crashes are sought
    most: int = 30  # crashes looked at
    steps: int = 10  # before a crash, looked at
    tries: int = 64  # episodes for each state and action, of which the best action is chosen
    checks: int = 512  # fresh ones of that action, and of the agent's own

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        number("episodes", self.episodes, least=1, integer=True)
        number("most", self.most, least=1, integer=True)
        number("steps", self.steps, least=1, most=100, integer=True)
        number("tries", self.tries, least=1, integer=True)
        number("checks", self.checks, least=1, integer=True)


class Crash(NamedTuple):
    """The steps up to the first danger of an episode, leading axis (steps,), oldest first."""

    states: Any
    action: np.ndarray
    threat: np.ndarray  # (steps, A)
    secure: np.ndarray
    hit: list[str]  # kinds of hazard
    length: int  # steps of the episode up to there
    insecure: int  # steps in a row, up to the crash, in which no action was admissible


def found(
    key: Array, agent: Agent, config: CrashConfig, on_progress: OnProgress = silent
) -> tuple[list[Crash], int, int]:
    """Plays episodes, and keeps the steps before the first danger of those that have any.

    Args:
        key: of the episodes.
        agent: in the world that it is tested in.
        config: sizes.
        on_progress: called with (stage, done, total, note).

    Returns:
        The first `config.most` crashes, how many there were in all, and of how many episodes.
    """
    pmdp, values = agent.pmdp, agent.values
    size = min(ROUND, config.episodes)
    limit = int(pmdp.params.time_limit)

    @jax.jit
    def play(key: Array, pmdp: PMDP) -> tuple[recording.Recording, dict[str, Array]]:
        start, go = jax.random.split(key)
        starts = jax.vmap(pmdp.env.reset, (0, None))(jax.random.split(start, size), pmdp.params)
        # One row more than steps: the state after the last one is seen too.
        shown = recording.record(go, pmdp, values, starts, limit + 1)
        hits = functools.partial(optional.collisions, pmdp.env)
        return shown, jax.vmap(jax.vmap(hits, (0, None)), (0, None))(shown.states, pmdp.params)

    crashes: list[Crash] = []
    count, rounds = 0, -(-config.episodes // size)
    for i in range(rounds):
        on_progress("episodes", i, rounds, f"{count} crashes of {i * size:,}")
        shown, collisions = play(jax.random.fold_in(key, i), pmdp)
        finite("crashes: threats", shown.threat)
        finite("crashes: dangers", shown.danger)
        met = np.asarray(shown.danger) > 0
        crashed = np.flatnonzero(met.any(axis=0))
        count += len(crashed)
        for episode in crashed[: config.most - len(crashes)]:
            at = int(met[:, episode].argmax()) + 1  # the state after the step
            kinds = [kind for kind, hit in collisions.items() if hit[at, episode]]
            crashes.append(ending(shown, int(episode), at, config.steps, kinds))
    on_progress("episodes", rounds, rounds, f"{count} crashes of {rounds * size:,}")
    return crashes, count, rounds * size


def ending(
    shown: recording.Recording, episode: int, at: int, steps: int, kinds: list[str]
) -> Crash:
    """Returns the last steps of an episode that crashed.

    Args:
        shown: several episodes.
        episode: which of them.
        at: row of the state in which it crashed.
        steps: how many, at most.
        kinds: of hazard that were hit.
    """
    part: Callable[[Any], np.ndarray] = lambda a: np.asarray(a[max(0, at - steps) : at, episode])  # noqa: E731
    secure = np.asarray(shown.secure[:at, episode])
    return Crash(
        states=jax.tree.map(part, shown.states),
        action=part(shown.action),
        threat=part(shown.threat),
        secure=part(shown.secure),
        hit=kinds,
        length=at,
        insecure=int(np.argmax(secure[::-1])) if secure.any() else at,
    )


def looked_at(
    key: Array, crash: Crash, explore: Callable[..., Any], config: CrashConfig
) -> list[dict[str, Any]]:
    """Returns a row of facts per step before a crash, oldest first.

    Args:
        key: of the episodes that go on from there.
        crash: what happened.
        explore: (key, state, action) -> (best action, what it seems to save, its risk, that of
            `action`).
        config: sizes.
    """
    rows, n = [], config.checks
    for t, action in enumerate(crash.action):
        state = jax.tree.map(lambda a, t=t: a[t], crash.states)
        best, saves, of_best, of_own = explore(jax.random.fold_in(key, t), state, action)
        rows.append(
            {
                "before": len(crash.action) - t,
                "secure": bool(crash.secure[t]),
                "threat": float(crash.threat[t].min()),
                "action": int(action),
                "risk": float(of_own),
                "risk_ci95": list(statistics.clopper_pearson(round(float(of_own) * n), n)),
                "best_action": int(best),
                "seems_to_save": float(saves),
                "best_risk": float(of_best),
                "best_risk_ci95": list(statistics.clopper_pearson(round(float(of_best) * n), n)),
            }
        )
    return rows


def explorer(pmdp: PMDP, values: rare.Values, config: CrashConfig) -> Callable[..., Any]:
    """Returns a compiled function that compares an action with the best one, by many episodes.

    The best action is chosen by some episodes and judged by others: the least of many estimates is
    too low.

    Args:
        pmdp: what is acted in.
        values: of the agent, which goes on after the action.
        config: sizes.

    Returns:
        (key, state, action) -> (best action, what it seems to save, its risk, that of `action`).
    """
    actions = jnp.arange(pmdp.num_actions)

    @jax.jit
    def explore(key: Array, state: Any, action: Array, pmdp: PMDP) -> Any:
        first, second = jax.random.split(key)
        one = jax.tree.map(lambda a: jnp.asarray(a)[None], state)
        tried = rare.risks(first, one, actions[None], pmdp, values, config.tries)[0]
        pair = jnp.stack([jnp.argmin(tried), action])
        risk = rare.risks(second, one, pair[None], pmdp, values, config.checks)[0]
        return pair[0], tried[action] - jnp.min(tried), risk[0], risk[1]

    return lambda key, state, action: explore(key, state, action, pmdp)


def summed_up(rows: list[dict[str, Any]], insecure: int) -> dict[str, Any]:
    """Returns what a crash comes down to.

    `entered` is the risk of the last admissible action, before the steps in which there was none
    (None where that is further back than the steps looked at); `missed` what the best action would
    have taken off the risk, at the step at which that seemed most by the episodes that chose it:
    those that judge it have no say in the step, for the greatest of many estimates is too high.

    Args:
        rows: of `looked_at`.
        insecure: steps up to the crash in which no action was admissible.
    """
    last = [row for row in rows if row["before"] == insecure + 1 and row["secure"]]
    most = max(rows, key=lambda row: row["seems_to_save"])
    return {
        "entered": last[0]["risk"] if last else None,
        "missed_before": most["before"],
        "missed": most["risk"] - most["best_risk"],
    }


def look_at_crashes(
    key: Array,
    agent: Agent,
    config: CrashConfig = CrashConfig(),
    *,
    on_result: Callable[[dict[str, Any]], None] | None = None,
    on_progress: OnProgress = silent,
) -> dict[str, Any]:
    """Finds crashes of an agent and looks at each, step by step.

    Args:
        key: of the episodes.
        agent: in the world that it is tested in.
        config: sizes.
        on_result: called with the results so far, after each crash.
        on_progress: called with (stage, done, total, note).

    Raises:
        ValueError: a number is out of range.
        FloatingPointError: a threat is not a finite number.
    """
    random_key("key", key)
    config.validate()
    find, look = jax.random.split(key_of(key, Stream.CRASHES))
    crashes, count, episodes = found(find, agent, config, on_progress)
    result: dict[str, Any] = {
        "x": float(agent.pmdp.x),
        "episodes": episodes,
        "crashes": count,
        "crash_ci95": list(statistics.clopper_pearson(count, episodes)),
        "tries": config.tries,
        "checks": config.checks,
        "looked_at": [],
    }
    explore = explorer(agent.pmdp, agent.values, config)
    for i, crash in enumerate(crashes):
        on_progress("crashes", i, len(crashes), "looking closely")
        rows = looked_at(jax.random.fold_in(look, i), crash, explore, config)
        result["looked_at"].append(
            {
                "hit": crash.hit,
                "length": crash.length,
                "insecure": crash.insecure,
                **summed_up(rows, crash.insecure),
                "steps": rows,
            }
        )
        on_progress("crashes", i + 1, len(crashes), "")
        if on_result is not None:
            on_result(result)
    return result
