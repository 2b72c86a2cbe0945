"""Point Gather: collect apples and avoid bombs in a square room, 15 steps (paper, appendix F).

Every bomb can be collected once, and an episode goes on after it: the danger of a step is the
number of bombs that it collects. So the discounted danger of an episode is the sum over bombs of
beta^K, K the step at which each is hit, and the threat under a baseline policy is *equal* to the
sum over bombs of single-bomb threats (Theorem 3 without slack, docs/theory.md).
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax.envs import base
from rp_jax.hazards import Bomb, SubRMDP
from rp_jax.kinematics import (
    AgentModel,
    Vehicle,
    angle_of,
    control_table,
    independent_controls,
    make_vehicle,
    squared_distance,
    to_ego,
)
from rp_jax.validate import number, one_of, positive

ROOM = 6.0  # half the side of the square room
ACCELERATIONS = tuple(k / 4 for k in range(-4, 5))  # steps forward, room units
TURNS = tuple(k / 16 for k in range(-4, 5))  # radians / step
FORWARD = (0.025,) * 4 + (0.18,) * 5  # the baseline steps back once in ten times
REACH = 1.0  # an object nearer than this to the centre of mass is collected
AHEAD = 0.04258348498809698  # of the centre of mass: the body's arrow weighs something
APPLE = 10.0  # reward of an apple
BINS = 10  # of each sensor, over the front half plane
RANGE = 6.0  # of the sensors, room units
LIDAR_BINS = 0
SCALE: tuple[float, ...] = (
    *(1 / 6, 1 / 6, 1.0),  # position, angle
    *(1.0, 1.0, 1.0),  # velocity
    *(1 / 6, 1 / 6, 1.0),  # centre of mass
    *(1.0,) * (2 * BINS),  # apples, bombs
)  # of an observation, for learners
USUAL_BOMBS = 8  # in the paper


class Objects(struct.PyTreeNode):
    """The apples, or the bombs."""

    position: Array  # (n, 2) room units
    present: Array  # (n,) bool, not yet collected


class State(struct.PyTreeNode):
    """The agent, what is left to collect, and whether the last step collected a bomb."""

    agent: Vehicle
    angle: Array  # () of the heading, radians, full turns included
    velocity: Array  # (3,) of the start, never to change: seen, and nothing else
    apples: Objects
    bombs: Objects
    hit: Array  # () bool
    time: Array  # () int32, steps since the start


class Params(struct.PyTreeNode):
    """Build by `make_params`; `time_limit` and `beta` can be replaced, or swept by `vmap`."""

    agent: AgentModel
    bomb: Bomb
    time_limit: Array  # () int32, steps
    beta: Array  # () discount of danger
    n_apples: int = struct.field(pytree_node=False, default=2)
    n_bombs: int = struct.field(pytree_node=False, default=USUAL_BOMBS)


def cells() -> np.ndarray:
    """(35, 2) where objects may lie: a grid of width 2 without its middle, where the agent is."""
    side = np.arange(-6.0, 6.0, 2.0)
    grid = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    return grid[np.abs(grid).max(axis=-1) > 0]


def make_params(
    n_apples: int = 2,
    n_bombs: int = USUAL_BOMBS,
    *,
    time_limit: int = 15,
    horizon: int = 15,
    beta: float = 0.999,
    fidelity: str = "released",
) -> Params:
    """The task's parameters, checked.

    Args:
        n_apples: 2 in the paper.
        n_bombs: 8 in the paper.
        time_limit: steps of an episode.
        horizon: steps after which a rollout of the threat is cut. The default cuts nothing off.
        beta: discount of danger in the threat.
        fidelity: "released" collects from the centre of mass of a body that is heavier in front;
            "paper" has a point mass.

    Raises:
        ValueError: a value is out of range.
    """
    one_of("fidelity", fidelity, base.FIDELITIES)
    room = len(cells())
    number("n_bombs", n_bombs, least=1, most=room, integer=True)
    # Of two numbers that do not fit together, that one is named which leaves its usual.
    number("n_apples", n_apples, least=0, most=room - min(n_bombs, USUAL_BOMBS), integer=True)
    number("n_bombs", n_bombs, least=1, most=room - n_apples, integer=True)
    positive("time_limit", time_limit, most=10**9, integer=True)
    positive("horizon", horizon, most=100, integer=True)
    positive("beta", beta, most=1.0)
    agent = AgentModel(
        actions=control_table(ACCELERATIONS, TURNS),
        baseline=independent_controls(ACCELERATIONS, FORWARD, TURNS, (1 / 9,) * 9),
        speeds=jnp.asarray(ACCELERATIONS, float),
        room=jnp.asarray(ROOM, float),
        delayed=False,
    )
    return Params(
        agent=agent,
        bomb=Bomb.create(agent, REACH, horizon, AHEAD if fidelity == "released" else 0.0),
        time_limit=jnp.asarray(time_limit, jnp.int32),
        beta=jnp.asarray(beta, float),
        n_apples=n_apples,
        n_bombs=n_bombs,
    )


def start_at(position: Array, angle: Array, apples: Array, bombs: Array) -> State:
    """A state with the agent and all objects anywhere, at time 0.

    Args:
        position: (2,) of the agent, room units.
        angle: () of its heading, radians.
        apples: (n, 2) positions.
        bombs: (m, 2) positions.
    """
    return State(
        agent=make_vehicle(position, angle, 0.0),
        angle=jnp.asarray(angle, float),
        velocity=jnp.zeros(3),
        apples=Objects(apples, jnp.ones(len(apples), bool)),
        bombs=Objects(bombs, jnp.ones(len(bombs), bool)),
        hit=jnp.asarray(False),
        time=jnp.asarray(0, jnp.int32),
    )


def reset(key: Array, params: Params) -> State:
    """The agent near the middle, facing along x; every object in a cell of its own."""
    pose_key, velocity_key, cell_key = jax.random.split(key, 3)
    pose = 0.01 * jax.random.normal(pose_key, (3,))
    grid = jnp.asarray(cells(), float)
    order = base.ranks(jax.random.uniform(cell_key, (len(grid),)))
    shuffled = jnp.zeros_like(grid).at[order].set(grid)
    apples, bombs, _ = jnp.split(shuffled, [params.n_apples, params.n_apples + params.n_bombs])
    state = start_at(pose[:2], pose[2], apples, bombs)
    return state.replace(velocity=0.1 * jax.random.normal(velocity_key, (3,)))


def _collect(agent: Vehicle, objects: Objects, params: Params) -> tuple[Objects, Array]:
    """What is left, and the number collected, () int."""
    taken = jax.vmap(params.bomb.hits, (None, 0))(agent, objects.position) & objects.present
    return objects.replace(present=objects.present & ~taken), jnp.sum(taken)


def step(key: Array, state: State, action: Array, params: Params) -> tuple[State, base.Outcome]:
    """One transition; `key` is not used, since nothing here is random.

    The reward is 10 per apple, the danger 1 per bomb. Only when nothing is left to collect does
    an episode end before the time limit.
    """
    del key
    control = params.agent.control(action)
    agent = params.agent.step(state.agent, control)
    apples, gained = _collect(agent, state.apples, params)
    bombs, hurt = _collect(agent, state.bombs, params)
    reached = state.replace(
        agent=agent,
        angle=state.angle + angle_of(control.rotation),
        apples=apples,
        bombs=bombs,
        hit=hurt > 0,
        time=state.time + 1,
    )
    left = jnp.any(apples.present) | jnp.any(bombs.present)
    terminated, truncated = base.ended(~left, reached.time, params.time_limit)
    return reached, base.Outcome(
        reward=APPLE * gained.astype(state.angle.dtype),
        danger=hurt.astype(state.angle.dtype),
        terminated=terminated,
        truncated=truncated,
        goal=jnp.zeros_like(left),
    )


def _readings(agent: Vehicle, objects: Objects, params: Params) -> Array:
    """(10,) per bin of the front half plane, right to left: 1 - distance / 6 of the nearest."""
    place = params.bomb.centre(agent)
    local = to_ego(objects.position - place[None], agent.heading[None])
    distance = jnp.sqrt(squared_distance(local, jnp.zeros((1, 2))))
    # In front, an object lies to the left of an edge where their cross product is positive.
    edges = np.linspace(-np.pi / 2, np.pi / 2, BINS + 1)[1:-1]
    c, s = (jnp.asarray(f(edges), local.dtype)[None] for f in (np.cos, np.sin))
    index = jnp.sum(local[:, 1:] * c >= local[:, :1] * s, axis=-1)
    seen = objects.present & (local[:, 0] >= 0) & (distance <= RANGE)
    inside = seen[:, None] & (index[:, None] == jnp.arange(BINS)[None])
    return jnp.max(jnp.where(inside, 1 - distance[:, None] / RANGE, 0.0), axis=0, initial=0.0)


def alone(state: State) -> State:
    """The state without hazards that move: bombs do not."""
    return state


def observe(state: State, params: Params) -> Array:
    """(29,) pose (3), velocity (3), centre of mass (3), apples seen (10), bombs seen (10)."""
    agent = state.agent
    return jnp.concatenate(
        [
            agent.position,
            state.angle[None],
            state.velocity,
            params.bomb.centre(agent),
            jnp.full(1, 0.5, agent.position.dtype),  # height of the body
            _readings(agent, state.apples, params),
            _readings(agent, state.bombs, params),
        ]
    )


def hazards(state: State, params: Params) -> dict[str, base.Hazards]:
    """The bombs that are left."""
    return {"bomb": base.Hazards(state.bombs.position, state.bombs.present)}


def causes(state: State, params: Params) -> dict[str, Array]:
    """Whether the step that led here has collected a bomb."""
    return {"bomb": state.hit}


def clearance(position: Array, params: Params) -> Array:
    """() infinite: nothing that can be hit stays from one episode to the next."""
    return jnp.full((), jnp.inf, position.dtype)


def sub_rmdps(params: Params) -> dict[str, SubRMDP]:
    """One agent and one bomb, in the same room."""
    return {"bomb": SubRMDP(agent=params.agent, source=params.bomb, beta=params.beta)}


def num_actions(params: Params) -> int:
    """81 = 9 steps forward x 9 turns."""
    return params.agent.actions.acceleration.shape[-1]
