"""The optional parts of an environment's contract, and their defaults."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.arrays import select
from rp_jax.envs.contract import Env, hits

RENEWED = 0.2  # probability that a part of a start is taken from another


def num_actions(env: Env, params: Any) -> int:
    """Returns the size of the discrete action set.

    Args:
        env: the environment; by default it has one action for each row of `params.body.actions`.
        params: the environment's parameters.
    """
    if hasattr(env, "num_actions"):
        return env.num_actions(params)
    return jax.tree.leaves(params.body.actions)[0].shape[0]


def collisions(env: Env, state: Any, params: Any) -> dict[str, Array]:
    """Returns, by kind, whether a hazard is being hit in a state, () bool each.

    Args:
        env: the environment; by default the hazards of its `hazards` count, as their source says.
        state: the state, unbatched.
        params: the environment's parameters.
    """
    if hasattr(env, "collisions"):
        return env.collisions(state, params)
    return hits(env.sub_rmdps(params), state.body, env.hazards(state, params))


def clearance(env: Env, position: Array, params: Any) -> Array:
    """Returns the distance left between the body and the nearest fixed hazard, () room units.

    Args:
        env: the environment; by default nothing is fixed, and the distance is infinite.
        position: (2,) of the body.
        params: the environment's parameters.
    """
    if hasattr(env, "clearance"):
        return env.clearance(position, params)
    return jnp.full((), jnp.inf, position.dtype)


def threshold(env: Env, state: Any, x: Array, least: Array) -> Array:
    """Returns the largest admissible threat in a state, ().

    Args:
        env: the environment.
        state: the state, unbatched.
        x: () the threshold of environments that do not say.
        least: () the least threat of any action.
    """
    return env.threshold(state, x, least) if hasattr(env, "threshold") else jnp.asarray(x)


def lookahead_above(env: Env, state: Any, x: Array) -> Array:
    """Returns the threat above which outcomes of actions are looked at, if every action has more.

    Args:
        env: the environment; by default it is the threshold.
        state: the state, unbatched.
        x: () the threshold of environments that do not say.
    """
    if hasattr(env, "lookahead_above"):
        return env.lookahead_above(state, x)
    return threshold(env, state, x, jnp.zeros_like(x))


def has_budget(env: Env) -> bool:
    """Returns whether states carry a budget of danger, which steps have to settle.

    Args:
        env: the environment.
    """
    return hasattr(env, "settle")


def booked(env: Env, before: Any, after: Any, danger: Array) -> Array:
    """Returns the danger that a step is booked with, (): by the budget's account if there is one.

    Over an episode both have the same mean. The account knows what nearly happened, too.

    Args:
        env: the environment; by default what happened is booked.
        before: the state before the step, unbatched.
        after: the state after it.
        danger: () of the step's outcome.
    """
    return after.booked - before.booked if has_budget(env) else danger


def mixed_start(env: Env, key: Array, start: Any, fresh: Any) -> Any:
    """Returns a start state like a given one, with some parts taken from another.

    Args:
        env: the environment; by default all of the start is taken from the other, with probability
            `RENEWED`, or nothing.
        key: random key.
        start: a start state.
        fresh: another one.
    """
    if hasattr(env, "mixed_start"):
        return env.mixed_start(key, start, fresh)
    return select(jax.random.bernoulli(key, RENEWED), fresh, start)


def lidar_bins(env: Env) -> int:
    """Returns how many of an observation's first values are distances of a LIDAR; 0 by default.

    Args:
        env: the environment.
    """
    return getattr(env, "LIDAR_BINS", 0)


def scale(env: Env) -> tuple[float, ...]:
    """Returns the factors of the observation beside the LIDAR that learners multiply it by.

    Args:
        env: the environment; by default the factors are 1, and the result is ().
    """
    return tuple(float(factor) for factor in getattr(env, "SCALE", ()))


def observation_size(env: Env, params: Any) -> int:
    """Returns the length of an observation, without computing one.

    Args:
        env: the environment.
        params: the environment's parameters.
    """

    def first(key: Array) -> Array:
        return env.observe(env.reset(key, params), params)

    return jax.eval_shape(first, jax.random.key(0)).shape[0]
