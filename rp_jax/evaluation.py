"""Evaluation: thousands of episodes in one program, each from its own key. Callers jit."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jax import Array

from rp_jax import shield, statistics
from rp_jax.arrays import select
from rp_jax.envs import optional
from rp_jax.envs.contract import Env
from rp_jax.planning.percept import Percept, non_finite
from rp_jax.planning.pmdp import PMDP
from rp_jax.rollout import Policy, Step, rollout
from rp_jax.validate import finite, none_bad, number, random_key, shared_length


class Episodes(NamedTuple):
    """Results of episodes, one row each."""

    score: Array  # reward, without penalty
    danger: Array  # 1 for a crash; may exceed 1 where an episode goes on after it
    goal: Array  # bool
    length: Array  # steps
    interventions: Array  # steps on which the mask changed the policy's own choice
    insecure: Array  # steps without an admissible action
    booked: Array  # danger booked, where episodes have a budget; else 0
    collisions: dict[str, Array]  # bool, what was hit
    bad_observations: Array  # steps on which a number was nan or infinite
    bad_threats: Array  # likewise


def action_values(network: nn.Module, weights: Any) -> Callable[[Percept], Array]:
    """Returns the function from a percept to the action values (B, A) of a Q-network.

    Args:
        network: of the action values.
        weights: of the network.
    """
    return lambda percept: jnp.asarray(network.apply(weights, percept.encoded))


def shielded(values: Callable[[Percept], Array]) -> Policy:
    """Returns the policy that is greedy inside the admissible set.

    Args:
        values: from a percept to scores of the actions (B, A).
    """

    def choose(_: Array, percept: Percept) -> tuple[Array, Array]:
        scores = values(percept)
        shared_length(admissible=percept.admissible, values=scores)
        action = jax.vmap(shield.masked_argmax)(scores, percept.admissible)
        return action, jnp.argmax(scores, axis=-1) != action

    return choose


def run_episodes(
    key: Array,
    pmdp: PMDP,
    values: Callable[[Percept], Array],
    episodes: int,
    *,
    batch: int = 1000,
) -> Episodes:
    """Plays episodes greedily inside the admissible set.

    Args:
        key: its episodes are independent of every other key's.
        pmdp: the environment, the threats and the threshold.
        values: scores the actions of a batch of states.
        episodes: how many.
        batch: episodes simulated side by side, at most.

    Returns:
        Rows with leading axis (episodes,).

    Raises:
        ValueError: a count is not above 0, or the scores are not (B, A).
    """
    return play_episodes(key, pmdp, shielded(values), episodes, batch=batch)


def play_episodes(
    key: Array, pmdp: PMDP, policy: Policy, episodes: int, *, batch: int = 1000
) -> Episodes:
    """Plays episodes of any policy, also of a random one or one with continuous actions.

    Args:
        key: its episodes are independent of every other key's.
        pmdp: the environment, the threats and the threshold.
        policy: chooses the actions.
        episodes: how many.
        batch: episodes simulated side by side, at most.

    Returns:
        Rows with leading axis (episodes,).

    Raises:
        ValueError: a count is not above 0.
    """
    random_key("key", key)
    number("episodes", episodes, least=1, integer=True)
    number("batch", batch, least=1, integer=True)
    batch = min(batch, episodes)
    keys = round_keys(key, episodes, batch)
    rows = jax.lax.map(lambda key: play_round(key, pmdp, policy, batch), keys)
    return jax.tree.map(lambda a: a.reshape(-1)[:episodes], rows)


def round_keys(key: Array, episodes: int, batch: int) -> Array:
    """Returns one key for each `play_round` of `play_episodes`, (rounds,).

    Args:
        key: of all episodes.
        episodes: how many, at least.
        batch: episodes of a round.
    """
    return jax.random.split(key, -(-episodes // batch))


def play_round(key: Array, pmdp: PMDP, policy: Policy, batch: int) -> Episodes:
    """Plays `batch` episodes side by side, each from a fresh start.

    Args:
        key: of starts, policy and environment.
        pmdp: the environment, the threats and the threshold.
        policy: chooses the actions.
        batch: how many.
    """
    start_key, play_key = jax.random.split(key)
    starts = jax.random.split(start_key, batch)
    states = jax.vmap(pmdp.env.reset, (0, None))(starts, pmdp.params)
    blank = no_episodes(pmdp.env, states, pmdp.params)
    return rollout(play_key, pmdp, policy, states, counting(pmdp.env, pmdp.params), blank)[1]


def counting(env: Env, params: Any) -> Callable[[Episodes, Step], Episodes]:
    """Returns the fold of `rollout` that counts episodes.

    Args:
        env: says what was hit.
        params: of the environment.
    """
    hits = functools.partial(optional.collisions, env)

    def fold(rows: Episodes, step: Step) -> Episodes:
        bad_observation, bad_threat = non_finite(step.percept.encoded, step.percept.threat)
        new = Episodes(
            score=step.outcome.reward,
            danger=step.outcome.danger,
            goal=step.outcome.goal,
            length=step.moved,
            interventions=step.changed,
            insecure=~step.percept.secure,
            booked=booked(env, step),
            collisions=jax.vmap(hits, (0, None))(step.reached, params),
            bad_observations=bad_observation,
            bad_threats=bad_threat,
        )
        return added(rows, new, step.moved)

    return fold


def booked(env: Env, step: Step) -> Array:
    """Returns the danger that a step was booked with, (B,); 0 where there are no budgets.

    Args:
        env: the environment.
        step: of all episodes.
    """
    if not optional.has_budget(env):
        return jnp.zeros_like(step.outcome.danger)
    return step.reached.booked - step.states.booked


def no_episodes(env: Env, states: Any, params: Any) -> Episodes:
    """Returns the rows of episodes (B,) before their first step.

    Args:
        env: the environment.
        states: where they begin, leading axis (B,).
        params: of the environment.
    """
    none = jnp.zeros(states.time.shape, bool)
    zero, count = none.astype(float), none.astype(jnp.int32)
    hits = functools.partial(optional.collisions, env)
    kinds = jax.eval_shape(jax.vmap(hits, (0, None)), states, params)
    collisions = dict.fromkeys(kinds, none)
    return Episodes(zero, zero, none, count, count, count, zero, collisions, count, count)


def added(rows: Episodes, step: Episodes, moved: Array) -> Episodes:
    """Returns the rows with what a step brought to those that moved.

    Args:
        rows: sums so far, (B,).
        step: of one step, (B,).
        moved: (B,) bool.
    """
    sums = jax.tree.map(lambda a, b: a | b if a.dtype == bool else a + b, rows, step)
    return jax.vmap(select)(moved, sums, rows)


def check(rows: Episodes, name: str) -> None:
    """Raises FloatingPointError if an episode saw or earned what is not a finite number.

    Args:
        rows: of the episodes.
        name: of them, for the message.
    """
    none_bad(name, rows)
    finite(f"{name}: returns", rows.score)
    finite(f"{name}: dangers", rows.danger)


def summarise(rows: Episodes, penalty: float) -> dict[str, Any]:
    """Returns what is reported of episodes; returns are over all of them, penalty included.

    A crash is an episode with any danger. `crash_ci95` is the two-sided Clopper-Pearson interval of
    the crash rate, `crash_upper95` the one-sided bound: what these episodes exclude. `danger_mean`
    is the danger of an episode, undiscounted, and `danger_ci95` its half-width; nan where there is
    none, for then its spread says nothing.

    Args:
        rows: arrays (n,).
        penalty: taken off the return of an episode per unit of danger.
    """
    rows = jax.tree.map(np.asarray, rows)
    n, k = rows.score.size, int((rows.danger > 0).sum())
    returns = rows.score - penalty * rows.danger
    mean, width = statistics.mean_interval(np.asarray(returns))
    danger, danger_width = statistics.mean_interval(np.asarray(rows.danger))
    steps = int(rows.length.sum())
    safe = rows.danger == 0
    low, high = statistics.clopper_pearson(k, n)
    return {
        "episodes": n,
        "return_mean": mean,
        "return_ci95": width,
        "uncrashed_return_mean": float(rows.score[safe].mean()) if safe.any() else float("nan"),
        "crashes": k,
        "crash_rate": k / n,
        "crash_ci95": [low, high],
        "crash_upper95": statistics.upper_bound(k, n),
        "danger_mean": danger,
        "danger_ci95": danger_width if k else float("nan"),
        "goal_rate": float(rows.goal.mean()),
        "interventions": float(rows.interventions.sum() / steps),
        "insecure": float(rows.insecure.sum() / steps),
        "steps": steps,
        "collisions": {kind: int((hit & ~safe).sum()) for kind, hit in rows.collisions.items()},
    }
