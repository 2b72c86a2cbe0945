"""The loop that plays episodes: evaluating, recording and splitting are folds over it."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.arrays import select
from rp_jax.envs.contract import Outcome

Carry = TypeVar("Carry")

# Chooses for a batch of states: (key, percept) -> (actions (B,) or (B, D), (B,) bool: these are
# not the actions that it would have preferred).
Policy = Callable[[Array, Any], tuple[Array, Array]]


class Playable(Protocol):
    """A world that episodes are played in: a `PMDP`, or anything that looks and steps like one."""

    def perceive(self, states: Any, alive: Array | None = None) -> Any:
        """Returns what the policy is told of states.

        Args:
            states: leading axis (B,).
            alive: (B,) bool; the other rows need not be right.
        """

    def advance(
        self, keys: Array, states: Any, actions: Array, percept: Any
    ) -> tuple[Any, Outcome]:
        """Makes one transition of each state.

        Args:
            keys: (B,).
            states: leading axis (B,).
            actions: (B,) or (B, D).
            percept: of the states.

        Returns:
            The states after, and the outcomes of the step.
        """


class Step(NamedTuple):
    """One step of all episodes, leading axes (B,)."""

    time: Array  # () int, steps made before
    alive: Array  # bool, the episode had not ended before this step
    moved: Array  # bool, the step counts: it was alive and not stopped
    states: Any  # before the step; after an end, the terminal state again
    percept: Any  # of `states`; of a terminal state only once
    action: Array
    changed: Array  # bool, not the action that the policy would have preferred
    reached: Any
    outcome: Outcome


def rollout(
    key: Array,
    world: Playable,
    policy: Policy,
    states: Any,
    fold: Callable[[Carry, Step], Carry],
    carry: Carry,
    *,
    alive: Array | None = None,
    stop: Callable[[Array, Any], Array] | None = None,
    over: Callable[[Outcome], Array] = lambda outcome: outcome.done,
    steps: int | None = None,
) -> tuple[Any, Carry]:
    """Plays episodes side by side, and folds over their steps.

    Args:
        key: of the policy's and the world's randomness; no row depends on another.
        world: where they are played.
        policy: chooses the actions.
        states: leading axis (B,), where the episodes go on from.
        fold: (carry, step) -> carry, called at every step, whether or not a row still moves.
        carry: a pytree of arrays, given to the first call of `fold`.
        alive: (B,) bool, the rows that move at all; all by default.
        stop: (time, percept) -> (B,) bool, rows that stop there before they act.
        over: from an outcome to (B,) bool, rows for which it was the last step.
        steps: how many are made, ended or not; by default, until every episode has ended.

    Returns:
        The states (B,) where the episodes ended or stopped, and the last carry.
    """
    act_key, step_key = jax.random.split(key)
    count = jax.tree.leaves(states)[0].shape[0]
    keys = jax.random.split(step_key, count)
    begin = jnp.ones(count, bool) if alive is None else alive

    def advance(loop: tuple) -> tuple:
        time, looked, alive, states, carry = loop
        percept = world.perceive(states, looked)
        moved = alive if stop is None else alive & ~stop(time, percept)
        action, changed = policy(jax.random.fold_in(act_key, time), percept)
        now = jax.vmap(jax.random.fold_in, (0, None))(keys, time)
        reached, outcome = world.advance(now, states, action, percept)
        step = Step(time, alive, moved, states, percept, action, changed, reached, outcome)
        kept = jax.vmap(select)(moved, reached, states)
        return time + 1, moved, moved & ~over(outcome), kept, fold(carry, step)

    def going(loop: tuple) -> Array:
        time, _, alive, *_ = loop
        return jnp.any(alive) if steps is None else time < steps

    first = (jnp.asarray(0), begin, begin, states, carry)
    *_, states, carry = jax.lax.while_loop(going, advance, first)
    return states, carry
