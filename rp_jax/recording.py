"""Episodes step by step, for figures and animations; and states that a policy comes by."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax import shield
from rp_jax.arrays import select
from rp_jax.evaluation import shielded
from rp_jax.planning.percept import Percept
from rp_jax.planning.pmdp import PMDP
from rp_jax.rollout import Step, rollout


class Recording(NamedTuple):
    """Episodes step by step, axes (time, episode)."""

    states: Any  # before each step; after an end, the terminal state again
    action: Array
    threat: Array  # (time, episode, A); of a terminal state only where it is met
    admissible: Array  # (time, episode, A)
    secure: Array
    alive: Array  # bool, the episode had not ended before this step
    danger: Array  # of this step; 0 after an end


def record(
    key: Array,
    pmdp: PMDP,
    values: Callable[[Percept], Array],
    starts: Any,
    steps: int,
) -> Recording:
    """Plays episodes from given states, greedily inside the admissible set, and keeps every step.

    Args:
        key: of the environment's randomness.
        pmdp: the environment, the threats and the threshold.
        values: scores the actions.
        starts: states with leading axis (episodes,).
        steps: how many are recorded, ended or not.
    """
    policy = shielded(values)

    def shown(step: Step) -> Recording:
        seen = step.percept
        return Recording(
            step.states,
            step.action,
            seen.threat,
            seen.admissible,
            seen.secure,
            step.alive,
            jnp.where(step.alive, step.outcome.danger, 0),
        )

    def fold(tape: Recording, step: Step) -> Recording:
        return jax.tree.map(lambda all, one: all.at[step.time].set(one), tape, shown(step))

    def first(starts: Any) -> Recording:
        percept = pmdp.perceive(starts)
        action, _ = policy(key, percept)
        alive = jnp.ones(percept.secure.shape, bool)
        seen = (percept.threat, percept.admissible, percept.secure)
        return Recording(starts, action, *seen, alive, jnp.zeros(alive.shape))

    blank = jax.tree.map(
        lambda a: jnp.zeros((steps, *a.shape), a.dtype), jax.eval_shape(first, starts)
    )
    return rollout(key, pmdp, policy, starts, fold, blank, steps=steps)[1]


def explore(key: Array, percept: Percept) -> tuple[Array, Array]:
    """Chooses uniformly inside the admissible set; a `rollout.Policy`.

    Args:
        key: of the choice.
        percept: of states (B,).
    """
    keys = jax.random.split(key, percept.secure.shape[0])
    action = jax.vmap(shield.masked_sample)(keys, percept.admissible)
    return action, jnp.zeros(percept.secure.shape, bool)


def visited_states(key: Array, pmdp: PMDP, count: int, steps: int = 30) -> Any:
    """Returns states (count,) that exploring in the admissible set comes by.

    Args:
        key: of starts, actions and the environment.
        pmdp: the environment, the threats and the threshold.
        count: how many.
        steps: each is reached in fewer than this, drawn uniformly; never a terminal one.
    """
    start_key, stop_key, walk_key = jax.random.split(key, 3)
    starts = jax.vmap(pmdp.env.reset, (0, None))(jax.random.split(start_key, count), pmdp.params)
    last = jax.random.randint(stop_key, (count,), 0, steps)

    def fold(kept: Any, step: Step) -> Any:
        going = step.moved & ~step.outcome.done
        return jax.vmap(select)(going, step.reached, kept)

    return rollout(
        walk_key,
        pmdp,
        explore,
        starts,
        fold,
        starts,
        stop=lambda time, _: time >= last,
        steps=steps,
    )[1]
