"""The room of Jam under another reward: go to and fro between two corners, and never leave.

Agent, obstacles and dangers are those of `rp_jax.envs.jam`, and so are the threats.
"""

import jax.numpy as jnp
from jax import Array

from rp_jax.envs import base, jam
from rp_jax.envs.jam import (  # noqa: F401
    LIDAR_BINS,
    Params,
    alone,
    causes,
    clearance,
    hazards,
    make_params,
    num_actions,
    sub_rmdps,
)
from rp_jax.kinematics import squared_distance

CORNERS = ((0.25, 2.75), (2.75, 0.25))  # middles of two safety zones, in turn
NEAR = 0.25  # a corner has been visited within this distance
SCALE: tuple[float, ...] = (*jam.SCALE, 1.0)


class State(jam.State):
    """A state of Jam, and where to go."""

    aim: Array  # () int32, index of a corner


def _heading_for(state: jam.State, aim: Array) -> State:
    fields = {name: getattr(state, name) for name in jam.State.__dataclass_fields__}
    return State(**fields, aim=aim)


def reset(key: Array, params: Params) -> State:
    """A start of Jam, with the first corner ahead."""
    return _heading_for(jam.reset(key, params), jnp.asarray(0, jnp.int32))


def step(key: Array, state: State, action: Array, params: Params) -> tuple[State, base.Outcome]:
    """A step of Jam that earns 20 x the way made to the corner, 10 on arrival, and -.05.

    Leaving through the exit ends the episode; the way of that step counts, and nothing more.
    """
    reached, outcome = jam.step(key, state, action, params)
    corner = jnp.asarray(CORNERS, reached.agent.position.dtype)[state.aim]
    before, after = (
        jnp.sqrt(squared_distance(corner, agent.position)) for agent in (state.agent, reached.agent)
    )
    arrived = (after < NEAR) & (outcome.danger == 0)
    reward = 20 * (before - after) - 0.05 + 10.0 * arrived
    outcome = outcome.replace(reward=reward, goal=jnp.zeros_like(outcome.goal))
    return _heading_for(reached, jnp.where(arrived, 1 - state.aim, state.aim)), outcome


def observe(state: State, params: Params) -> Array:
    """(397,) the observation of Jam, and which corner it is."""
    seen = jam.observe(state, params)
    return jnp.concatenate([seen, state.aim[None].astype(seen.dtype)])
