"""Steps of a batch of environments in which ended episodes start again."""

from collections.abc import Callable
from typing import Any

import jax
from jax import Array

from rp_jax.arrays import replace_rows
from rp_jax.envs.contract import Env, Outcome


def step_and_renew(
    env: Env,
    keys: Array,
    states: Any,
    actions: Array,
    params: Any,
    look: Callable[[Any], Any],
    *,
    restart: Array | None = None,
    advance: Callable[[Array, Any, Array], tuple[Any, Outcome]] | None = None,
) -> tuple[tuple[Any, Any], tuple[Any, Any], Outcome]:
    """Makes a step of a batch, restarts ended episodes, and looks at all states.

    New starts are drawn and looked at only for the episodes that have ended.

    Args:
        env: the environment.
        keys: (B,) random keys; each row depends on its own key only.
        states: states, leading axis (B,).
        actions: (B,) int, or (B, D) float where they are continuous.
        params: the environment's parameters, unbatched.
        look: maps a batch of states, of any size, to a pytree with a row for each.
        advance: makes a step of the batch from (keys, states, actions); by default `env.step` does.
        restart: () bool, whether all episodes end with this step, whatever it leads to.

    Returns:
        (carried, reached, outcome), leading axes (B,). `carried` holds the states to continue from,
        new starts included, and what `look` says of them; `reached` holds the states that the step
        led to, terminal ones included, and what `look` says of them.
    """
    both = jax.vmap(jax.random.split)(keys)
    if advance is None:
        reached, outcome = jax.vmap(env.step, (0, 0, 0, None))(both[:, 0], states, actions, params)
    else:
        reached, outcome = advance(both[:, 0], states, actions)
    if restart is not None:
        terminated, truncated = outcome.terminated | restart, outcome.truncated & ~restart
        outcome = outcome.replace(terminated=terminated, truncated=truncated)

    def starts(rows: Array) -> Any:
        fresh = jax.vmap(env.reset, (0, None))(both.at[rows, 1].get(mode="clip"), params)
        return fresh, look(fresh)

    seen = (reached, look(reached))
    return replace_rows(outcome.done, seen, starts), seen, outcome


def auto_reset_step(
    env: Env, keys: Array, states: Any, actions: Array, params: Any
) -> tuple[Any, Any, Outcome]:
    """Makes a step of a batch, and draws a new start wherever an episode has ended.

    Args:
        env: the environment.
        keys: (B,) random keys; each row depends on its own key only.
        states: states, leading axis (B,).
        actions: (B,) int, or (B, D) float where they are continuous.
        params: the environment's parameters, unbatched.

    Returns:
        (carried, reached, outcome), leading axes (B,): the states to continue from, new starts
        included; the states that the step led to, terminal ones included; and the step's outcome.
    """
    carried, reached, outcome = step_and_renew(env, keys, states, actions, params, lambda _: ())
    return carried[0], reached[0], outcome
