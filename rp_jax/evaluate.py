"""Evaluation: thousands of episodes in one program, each from its own key. Callers jit."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jax import Array

from rp_jax import shield, statistics
from rp_jax.envs.base import Env, select
from rp_jax.planning.pmdp import PMDP, Percept, faults
from rp_jax.validate import finite, leading, none_bad, number, random_key

# Chooses for a batch of states: (key, percept) -> (actions (B,) or (B, 2), (B,) bool: these are
# not the actions that it would have preferred).
Policy = Callable[[Array, Percept], tuple[Array, Array]]


class Episodes(NamedTuple):
    """One row per episode."""

    score: Array  # reward, without penalty
    danger: Array  # 1 for a crash; may exceed 1 where an episode goes on after it
    goal: Array  # bool
    length: Array  # steps
    interventions: Array  # steps on which the mask changed the policy's own choice
    insecure: Array  # steps without an admissible action
    causes: dict[str, Array]  # bool, what was hit
    bad_observations: Array  # steps on which a number was nan or infinite
    bad_threats: Array  # likewise


def action_values(network: nn.Module, weights: Any) -> Callable[[Percept], Array]:
    """Action values of a learned Q-network, (B, A)."""
    return lambda percept: jnp.asarray(network.apply(weights, percept.encoded))


def shielded(values: Callable[[Percept], Array]) -> Policy:
    """Acts greedily inside the admissible set, by action values (B, A)."""

    def choose(_: Array, percept: Percept) -> tuple[Array, Array]:
        scores = values(percept)
        leading(admissible=percept.admissible, values=scores)
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
    """Acts greedily inside the admissible set until each episode ends.

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
    """`run_episodes` of any policy, also of a random one or one with continuous actions.

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
    """(rounds,) one for each `play_round` of `play_episodes`."""
    return jax.random.split(key, -(-episodes // batch))


def play_round(key: Array, pmdp: PMDP, policy: Policy, batch: int) -> Episodes:
    """`batch` episodes side by side; what `play_episodes` does as often as it needs to."""
    start_key, step_key, act_key = jax.random.split(key, 3)
    keys = jax.random.split(step_key, batch)
    starts = jax.random.split(start_key, batch)
    states = jax.vmap(pmdp.env.reset, (0, None))(starts, pmdp.params)

    def advance(carry):
        t, alive, states, rows = carry
        percept = pmdp.perceive(states, alive)
        action, changed = policy(jax.random.fold_in(act_key, t), percept)
        step_keys = jax.vmap(jax.random.fold_in, (0, None))(keys, t)
        step = jax.vmap(pmdp.env.step, (0, 0, 0, None))
        reached, outcome = step(step_keys, states, action, pmdp.params)
        hit = jax.vmap(pmdp.env.causes, (0, None))(reached, pmdp.params)
        bad_observation, bad_threat = faults(percept.encoded, percept.threat)
        new = Episodes(
            score=outcome.reward,
            danger=outcome.danger,
            goal=outcome.goal,
            length=alive,
            interventions=changed,
            insecure=~percept.secure,
            causes=hit,
            bad_observations=bad_observation,
            bad_threats=bad_threat,
        )
        return t + 1, alive & ~outcome.done, reached, added(rows, new, alive)

    carry = (jnp.asarray(0), jnp.ones(batch, bool), states, blank(pmdp.env, states, pmdp.params))
    return jax.lax.while_loop(lambda c: jnp.any(c[1]), advance, carry)[3]


def blank(env: Env, states: Any, params: Any) -> Episodes:
    """Of episodes (B,) that have not begun."""
    none = jnp.zeros(states.time.shape, bool)
    zero, count = none.astype(float), none.astype(jnp.int32)
    kinds = jax.eval_shape(jax.vmap(env.causes, (0, None)), states, params)
    causes = dict.fromkeys(kinds, none)
    return Episodes(zero, zero, none, count, count, count, causes, count, count)


def added(rows: Episodes, step: Episodes, alive: Array) -> Episodes:
    """Counts what a `step` brought in the episodes that are `alive` (B,), in which it was made."""
    sums = jax.tree.map(lambda a, b: a | b if a.dtype == bool else a + b, rows, step)
    return jax.vmap(select)(alive, sums, rows)


def check(rows: Episodes, name: str) -> None:
    """Raises FloatingPointError if an episode saw or earned what is not a finite number."""
    none_bad(name, rows)
    finite(f"{name}: returns", rows.score)
    finite(f"{name}: dangers", rows.danger)


def summarise(rows: Episodes, penalty: float) -> dict[str, Any]:
    """What is reported of some episodes; returns are over all of them, penalty included.

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
        "causes": {kind: int((hit & ~safe).sum()) for kind, hit in rows.causes.items()},
    }


class Recording(NamedTuple):
    """Episodes step by step, axes (time, episode)."""

    states: Any  # before each step; after an end, the terminal state again
    action: Array
    threat: Array  # (time, episode, A); of a terminal state only where it is met
    admissible: Array  # (time, episode, A)
    secure: Array
    alive: Array  # bool, the episode had not ended before this step


def record(
    key: Array,
    pmdp: PMDP,
    values: Callable[[Percept], Array],
    starts: Any,
    steps: int,
) -> Recording:
    """Plays episodes from given states and keeps every step, for figures and animations.

    Args:
        key: of the environment's randomness.
        pmdp: the environment, the threats and the threshold.
        values: scores the actions.
        starts: states with leading axis (episodes,).
        steps: how many are recorded, ended or not.
    """
    count = starts.time.shape[0]

    def step(carry, key):
        states, alive, looked = carry
        percept = pmdp.perceive(states, looked)
        action = jax.vmap(shield.masked_argmax)(values(percept), percept.admissible)
        keys = jax.random.split(key, count)
        move = jax.vmap(pmdp.env.step, (0, 0, 0, None))
        reached, outcome = move(keys, states, action, pmdp.params)
        kept = jax.vmap(select)(alive, reached, states)
        shown = Recording(states, action, percept.threat, percept.admissible, percept.secure, alive)
        return (kept, alive & ~outcome.done, alive), shown

    begin = (starts, jnp.ones(count, bool), jnp.ones(count, bool))
    return jax.lax.scan(step, begin, jax.random.split(key, steps))[1]


def visited_states(key: Array, pmdp: PMDP, count: int, steps: int = 30) -> Any:
    """States (count,) that exploring in the admissible set comes by in fewer than `steps` steps."""
    start_key, stop_key, walk_key = jax.random.split(key, 3)
    starts = jax.vmap(pmdp.env.reset, (0, None))(jax.random.split(start_key, count), pmdp.params)
    stop = jax.random.randint(stop_key, (count,), 0, steps)

    def step(carry, key):
        states, alive, t = carry
        walking = alive & (t < stop)
        percept = pmdp.perceive(states, walking)
        pick, move = jax.random.split(key)
        action = jax.vmap(shield.masked_sample)(jax.random.split(pick, count), percept.admissible)
        keys = jax.random.split(move, count)
        move_all = jax.vmap(pmdp.env.step, (0, 0, 0, None))
        reached, outcome = move_all(keys, states, action, pmdp.params)
        going = walking & ~outcome.done
        return (jax.vmap(select)(going, reached, states), going, t + 1), None

    begin = (starts, jnp.ones(count, bool), jnp.asarray(0))
    return jax.lax.scan(step, begin, jax.random.split(walk_key, steps))[0][0]
