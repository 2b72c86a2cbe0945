"""Point Gather: collect apples and avoid bombs in a square room, 15 steps (paper, appendix F).

Every bomb can be collected once, and the episode continues: the danger of a step is the number of
bombs that it collects. So the discounted danger of an episode is the sum over bombs of beta^K,
where K is the step at which each is hit, and the threat under a baseline policy is *equal* to the
sum over bombs of single-bomb threats (Theorem 3 with equality, docs/theory.md).
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax import arrays
from rp_jax.dynamics import (
    Vehicle,
    VehicleModel,
    angle_of,
    control_table,
    independent_controls,
    make_vehicle,
    squared_distance,
    to_body_frame,
)
from rp_jax.envs import contract
from rp_jax.hazards import Bomb, SubRMDP
from rp_jax.validate import number, one_of, positive

ROOM = 6.0  # half the side of the square room, room units
ACCELERATIONS = tuple(k / 4 for k in range(-4, 5))  # steps forward, room units
TURNS = tuple(k / 16 for k in range(-4, 5))  # radians / step
FORWARD = (0.025,) * 4 + (0.18,) * 5  # probabilities: the baseline policy steps back one time in 10
REACH = 1.0  # objects nearer than this to the centre of mass are collected, room units
AHEAD = 0.04258348498809698  # room units by which the body's arrow moves its centre of mass forward
APPLE = 10.0  # reward of an apple
BINS = 10  # number of bins of each sensor, over the front half plane
RANGE = 6.0  # range of the sensors, room units
LIDAR_BINS = 0
SCALE: tuple[float, ...] = (
    *(1 / 6, 1 / 6, 1.0),  # position, angle
    *(1.0, 1.0, 1.0),  # velocity
    *(1 / 6, 1 / 6, 1.0),  # centre of mass
    *(1.0,) * (2 * BINS),  # apples, bombs
)  # factors of an observation, for learners
USUAL_BOMBS = 8  # number of bombs in the paper


class Objects(struct.PyTreeNode):
    """The apples of a state, or its bombs."""

    position: Array  # (n, 2) room units
    present: Array  # (n,) bool, not yet collected


class State(struct.PyTreeNode):
    """The body, the objects, and whether the last step collected a bomb."""

    body: Vehicle
    angle: Array  # () angle of the heading, radians, full turns included
    velocity: Array  # (3,) drawn at the start; it is observed, never changes, and has no effect
    apples: Objects
    bombs: Objects
    hit: Array  # () bool, the last step collected a bomb
    time: Array  # () int32, steps since the start


class Params(struct.PyTreeNode):
    """The task's parameters; to be built by `make_params`.

    The fields `time_limit` and `beta` can be replaced, or swept by `vmap`.
    """

    body: VehicleModel
    bomb: Bomb
    time_limit: Array  # () int32, steps of an episode
    beta: Array  # () discount of danger in the threat
    num_apples: int = struct.field(pytree_node=False, default=2)
    num_bombs: int = struct.field(pytree_node=False, default=USUAL_BOMBS)


def cells() -> np.ndarray:
    """Returns the places where objects may lie, (35, 2) room units.

    They form a grid of width 2, without the middle, where the body starts.
    """
    side = np.arange(-6.0, 6.0, 2.0)
    grid = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    return grid[np.abs(grid).max(axis=-1) > 0]


@jax.ensure_compile_time_eval()  # tables of plain numbers, also where a caller is being traced
def make_params(
    num_apples: int = 2,
    num_bombs: int = USUAL_BOMBS,
    *,
    time_limit: int = 15,
    horizon: int = 15,
    beta: float = 0.999,
    fidelity: str = "released",
) -> Params:
    """Returns the task's parameters, checked.

    Args:
        num_apples: number of apples; 2 in the paper.
        num_bombs: number of bombs; 8 in the paper.
        time_limit: steps of an episode.
        horizon: steps after which a rollout of the threat is cut; the default cuts nothing off.
        beta: discount of danger in the threat.
        fidelity: "released" collects from the centre of mass of a body that is heavier in front;
            "paper" has a point mass.

    Raises:
        ValueError: a value is out of range.
    """
    one_of("fidelity", fidelity, contract.FIDELITIES)
    room = len(cells())
    number("num_bombs", num_bombs, least=1, most=room, integer=True)
    # If two numbers do not fit together, the message names the one that differs from the paper's.
    number("num_apples", num_apples, least=0, most=room - min(num_bombs, USUAL_BOMBS), integer=True)
    number("num_bombs", num_bombs, least=1, most=room - num_apples, integer=True)
    positive("time_limit", time_limit, most=10**9, integer=True)
    positive("horizon", horizon, most=100, integer=True)
    positive("beta", beta, most=1.0)
    body = VehicleModel(
        actions=control_table(ACCELERATIONS, TURNS),
        baseline=independent_controls(ACCELERATIONS, FORWARD, TURNS, (1 / 9,) * 9),
        speeds=jnp.asarray(ACCELERATIONS, float),
        room=jnp.asarray(ROOM, float),
        delayed=False,
    )
    return Params(
        body=body,
        bomb=Bomb.create(body, REACH, horizon, AHEAD if fidelity == "released" else 0.0),
        time_limit=jnp.asarray(time_limit, jnp.int32),
        beta=jnp.asarray(beta, float),
        num_apples=num_apples,
        num_bombs=num_bombs,
    )


def start_at(position: Array, angle: Array, apples: Array, bombs: Array) -> State:
    """Returns a state at time 0 with body and objects in given places.

    Args:
        position: (2,) of the body, room units.
        angle: () angle of its heading, radians.
        apples: (n, 2) positions of the apples, room units.
        bombs: (m, 2) positions of the bombs, room units.
    """
    return State(
        body=make_vehicle(position, angle, 0.0),
        angle=jnp.asarray(angle, float),
        velocity=jnp.zeros(3),
        apples=Objects(apples, jnp.ones(len(apples), bool)),
        bombs=Objects(bombs, jnp.ones(len(bombs), bool)),
        hit=jnp.asarray(False),
        time=jnp.asarray(0, jnp.int32),
    )


def reset(key: Array, params: Params) -> State:
    """Draws a start: the body near the middle, facing along x, and objects in cells of their own.

    Args:
        key: random key.
        params: the task's parameters.
    """
    pose_key, velocity_key, cell_key = jax.random.split(key, 3)
    pose = 0.01 * jax.random.normal(pose_key, (3,))
    grid = jnp.asarray(cells(), float)
    order = arrays.ranks(jax.random.uniform(cell_key, (len(grid),)))
    shuffled = jnp.zeros_like(grid).at[order].set(grid)
    apples, bombs, _ = jnp.split(
        shuffled, [params.num_apples, params.num_apples + params.num_bombs]
    )
    state = start_at(pose[:2], pose[2], apples, bombs)
    return state.replace(velocity=0.1 * jax.random.normal(velocity_key, (3,)))


def _collect(body: Vehicle, objects: Objects, params: Params) -> tuple[Objects, Array]:
    """Returns the objects that are left, and the number collected, () int."""
    taken = jax.vmap(params.bomb.hits, (None, 0))(body, objects.position) & objects.present
    return objects.replace(present=objects.present & ~taken), jnp.sum(taken)


def step(key: Array, state: State, action: Array, params: Params) -> tuple[State, contract.Outcome]:
    """Makes one transition, which is deterministic.

    The reward is 10 per apple, the danger 1 per bomb. The episode ends before the time limit only
    when nothing is left to collect.

    Args:
        key: not used.
        state: the state before.
        action: () int, or (2,) float, as for `VehicleModel.control`.
        params: the task's parameters.

    Returns:
        The state after, and the step's outcome.
    """
    del key
    control = params.body.control(action)
    body = params.body.step(state.body, control)
    apples, gained = _collect(body, state.apples, params)
    bombs, hurt = _collect(body, state.bombs, params)
    reached = state.replace(
        body=body,
        angle=state.angle + angle_of(control.rotation),
        apples=apples,
        bombs=bombs,
        hit=hurt > 0,
        time=state.time + 1,
    )
    left = jnp.any(apples.present) | jnp.any(bombs.present)
    terminated, truncated = contract.ended(~left, reached.time, params.time_limit)
    return reached, contract.Outcome(
        reward=APPLE * gained.astype(state.angle.dtype),
        danger=hurt.astype(state.angle.dtype),
        terminated=terminated,
        truncated=truncated,
        goal=jnp.zeros_like(left),
    )


def _readings(body: Vehicle, objects: Objects, params: Params) -> Array:
    """Returns a sensor's readings (10,): 1 - distance / 6 of the nearest object in each bin.

    The bins divide the front half plane, from right to left; 0 stands for no object.
    """
    place = params.bomb.centre(body)
    local = to_body_frame(objects.position - place[None], body.heading[None])
    distance = jnp.sqrt(squared_distance(local, jnp.zeros((1, 2))))
    # In front, an object lies to the left of an edge where their cross product is positive.
    edges = np.linspace(-np.pi / 2, np.pi / 2, BINS + 1)[1:-1]
    c, s = (jnp.asarray(f(edges), local.dtype)[None] for f in (np.cos, np.sin))
    index = jnp.sum(local[:, 1:] * c >= local[:, :1] * s, axis=-1)
    seen = objects.present & (local[:, 0] >= 0) & (distance <= RANGE)
    inside = seen[:, None] & (index[:, None] == jnp.arange(BINS)[None])
    return jnp.max(jnp.where(inside, 1 - distance[:, None] / RANGE, 0.0), axis=0, initial=0.0)


def without_moving_hazards(state: State) -> State:
    """Returns the state unchanged, since bombs do not move.

    Args:
        state: any state.
    """
    return state


def observe(state: State, params: Params) -> Array:
    """Returns the observation of a state.

    Args:
        state: the state.
        params: the task's parameters.

    Returns:
        (29,) position and angle (3), velocity (3), centre of mass (3), readings for apples (10) and
        for bombs (10).
    """
    body = state.body
    return jnp.concatenate(
        [
            body.position,
            state.angle[None],
            state.velocity,
            params.bomb.centre(body),
            jnp.full(1, 0.5, body.position.dtype),  # height of the body
            _readings(body, state.apples, params),
            _readings(body, state.bombs, params),
        ]
    )


def hazards(state: State, params: Params) -> dict[str, contract.Hazards]:
    """Returns the bombs, of which those not yet collected are present.

    Args:
        state: the state.
        params: the task's parameters.
    """
    return {"bomb": contract.Hazards(state.bombs.position, state.bombs.present)}


def collisions(state: State, params: Params) -> dict[str, Array]:
    """Returns whether the step that led to the state collected a bomb, () bool under "bomb".

    Args:
        state: the state.
        params: the task's parameters.
    """
    return {"bomb": state.hit}


def clearance(position: Array, params: Params) -> Array:
    """Returns infinity, since no hazard is in the same place in all episodes.

    Args:
        position: (2,) of the body.
        params: the task's parameters.
    """
    return jnp.full((), jnp.inf, position.dtype)


def sub_rmdps(params: Params) -> dict[str, SubRMDP]:
    """Returns the sub-R-MDP of the body and one bomb, in the same room.

    Args:
        params: the task's parameters.
    """
    return {"bomb": SubRMDP(body=params.body, source=params.bomb, beta=params.beta)}


def num_actions(params: Params) -> int:
    """Returns the number of actions: 9 steps forward times 9 turns.

    Args:
        params: the task's parameters.
    """
    return params.body.actions.acceleration.shape[-1]
