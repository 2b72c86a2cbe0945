"""Patrol: Jam's room under another reward, to drive back and forth between two corners.

Vehicle, obstacles and dangers are those of `rp_jax.envs.jam`, and so are the threats.
"""

import jax.numpy as jnp
from jax import Array

from rp_jax.dynamics import squared_distance
from rp_jax.envs import contract, jam
from rp_jax.envs.jam import (  # noqa: F401
    LIDAR_BINS,
    Params,
    clearance,
    collisions,
    hazards,
    make_params,
    mixed_start,
    num_actions,
    sub_rmdps,
    without_moving_hazards,
)

CORNERS = ((0.25, 2.75), (2.75, 0.25))  # centres of two safety zones, to be visited in turn
NEAR = 0.25  # distance within which a corner counts as visited, room units
SCALE: tuple[float, ...] = (*jam.SCALE, 1.0)


class State(jam.State):
    """A state of Jam, with the corner to drive to."""

    aim: Array  # () int32, index of a corner


def _heading_for(state: jam.State, aim: Array) -> State:
    fields = {name: getattr(state, name) for name in jam.State.__dataclass_fields__}
    return State(**fields, aim=aim)


def reset(key: Array, params: Params) -> State:
    """Draws a start of Jam, with the first corner as the aim.

    Args:
        key: random key.
        params: Jam's parameters.
    """
    return _heading_for(jam.reset(key, params), jnp.asarray(0, jnp.int32))


def step(key: Array, state: State, action: Array, params: Params) -> tuple[State, contract.Outcome]:
    """Makes one transition of Jam with the reward of this task.

    The reward is 20 times the distance gained towards the corner, plus 10 on arrival, minus 0.05.
    Leaving through the exit ends the episode, with no other reward than for the distance.

    Args:
        key: random key.
        state: the state before.
        action: () int, or (2,) float, as for `VehicleModel.control`.
        params: Jam's parameters.

    Returns:
        The state after, and the step's outcome.
    """
    reached, outcome = jam.step(key, state, action, params)
    corner = jnp.asarray(CORNERS, reached.body.position.dtype)[state.aim]
    before, after = (
        jnp.sqrt(squared_distance(corner, body.position)) for body in (state.body, reached.body)
    )
    arrived = (after < NEAR) & (outcome.danger == 0)
    reward = 20 * (before - after) - 0.05 + jnp.where(arrived, 10.0, 0.0)
    outcome = outcome.replace(reward=reward, goal=jnp.zeros_like(outcome.goal))
    return _heading_for(reached, jnp.where(arrived, 1 - state.aim, state.aim)), outcome


def observe(state: State, params: Params) -> Array:
    """Returns the observation of Jam, with the index of the corner appended.

    Args:
        state: the state.
        params: Jam's parameters.

    Returns:
        (397,).
    """
    seen = jam.observe(state, params)
    return jnp.concatenate([seen, state.aim[None].astype(seen.dtype)])
