"""Jam: leave a room through its exit among randomly moving obstacles (paper, appendix F)."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax import arrays
from rp_jax.dynamics import (
    Control,
    Plans,
    Vehicle,
    VehicleModel,
    angle_of,
    control_table,
    independent_controls,
    make_plans,
    make_vehicle,
    squared_distance,
    to_body_frame,
)
from rp_jax.envs import contract, optional, sensing
from rp_jax.envs.walls import FARTHEST, least_radius
from rp_jax.hazards import MovingObstacle, SubRMDP, WallPoint
from rp_jax.validate import number, one_of, positive

ROOM = 3.0  # side of the square room by default, room units
MOST_ROOM = 30.0  # greatest side: tables of walls grow with it
EXIT = 0.8  # width of the gap at the right end of the top wall
SPACING = 0.02  # distance between the walls' points, room units
ACCELERATIONS = (-0.02, 0.0, 0.02)  # room units / step^2
TURNS = (-0.3, -0.1, 0.0, 0.1, 0.3)  # radians / step
SPEEDS = tuple(round(0.02 * k, 2) for k in range(-5, 6))  # -.1 .. .1 room units / step
OBSTACLE_SPEEDS = (0.0, 0.02, 0.04, 0.06)
OBSTACLE_TURNS = (-0.15, -0.05, 0.0, 0.05, 0.15)
CLEARANCE = 1.0  # obstacles appear at least this far from the agent's vehicle, room units
ZONE = 0.5  # side (released) or radius (paper) of the safety zones in the corners, room units
LIDAR_BINS = 360
SEEN_OBSTACLES = 8  # number of nearest obstacles that are observed
SCALE: tuple[float, ...] = (1.0, 1.0, 1.0, 10.0) * (
    SEEN_OBSTACLES + 1
)  # factors of x, y, heading and speed, for learners
UNSEEN = (-1.5, -1.51)  # where the observation puts obstacles that do not exist
COUNT = 0xC0DE  # folded into a start's key to draw the number of obstacles
EVADING = 3  # steps for which plans drive on or back off before they brake


class State(struct.PyTreeNode):
    """The agent's vehicle, the obstacles, and the progress made."""

    body: Vehicle
    obstacles: Vehicle  # leading axis (N,)
    present: Array  # (N,) bool, which obstacles exist; in "paper" they disappear in safety zones
    progress: Array  # () -20 times the distance to the goal (rounded in "released")
    time: Array  # () int32, steps since the start


class Draws(struct.PyTreeNode):
    """All random numbers of one step; recorded ones can be used to replay a transition."""

    controls: Control  # (N,) the obstacles' controls
    relocated: Vehicle  # (N,) where obstacles that have left the room appear again


class Params(struct.PyTreeNode):
    """The task's parameters; to be built by `make_params`.

    Another radius, speed or horizon needs new parameters, since tables depend on them. The fields
    `start`, `time_limit`, `stop_speed`, `beta` and `fewest` can be replaced, or swept by `vmap`.
    """

    body: VehicleModel
    wall: WallPoint
    obstacle: MovingObstacle
    start: Vehicle  # where the agent's vehicle starts
    goal: Array  # (2,) the point that progress is measured to, room units
    walls: sensing.DistanceField | None  # distance to the walls, where plans need it
    walls_in_view: sensing.PointGrid  # finds wall points within the LIDAR's range
    walls_in_contact: sensing.PointGrid  # finds wall points within the vehicle's radius
    walls_in_reach: sensing.PointGrid  # finds wall points that may have a threat
    time_limit: Array  # () int32, steps of an episode
    stop_speed: Array  # () a step at less than this speed costs 0.05
    radius: Array  # () radius of every vehicle, room units
    beta: Array  # () discount of danger in the threat
    fewest: Array  # () int32, least number of obstacles that an episode begins with
    room: Array  # () side of the square room, room units
    num_obstacles: int = struct.field(pytree_node=False, default=8)
    fidelity: str = struct.field(pytree_node=False, default="released")  # or "paper"


def wall_points(room: float = ROOM) -> np.ndarray:
    """Returns the points of the room's walls, one every `SPACING`, without the exit.

    Args:
        room: side of the room, room units.

    Returns:
        (P, 2) room units; P is 559 for a side of 3.
    """
    way = np.arange(math.ceil(room / SPACING - 1e-9)) * SPACING
    bottom, left = np.stack([way, 0 * way], 1), np.stack([0 * way, way], 1)
    top = np.stack([way, 0 * way + room], 1)
    right = np.stack([0 * way + room, way], 1)
    walls = np.concatenate([bottom, top[way < room - EXIT - 1e-9], left, right])
    _, first = np.unique(walls.round(9), axis=0, return_index=True)
    return walls[np.sort(first)]


@jax.ensure_compile_time_eval()  # tables of plain numbers, also where a caller is being traced
def make_params(
    num_obstacles: int = 8,
    *,
    time_limit: int = 100,
    radius: float = 0.1,
    room: float = ROOM,
    beta: float = 0.999,
    fewest: int | None = None,
    wall_horizon: int = 5,
    obstacle_horizon: int = 8,
    fidelity: str = "released",
    baseline: str = "paper",
) -> Params:
    """Returns the task's parameters, checked.

    Args:
        num_obstacles: number of obstacles; 8 in the paper, 3 and 15 for transfer.
        time_limit: steps of an episode.
        radius: radius of every vehicle, room units.
        room: side of the square room, room units; the exit and the goal stay at its upper right
            corner.
        beta: discount of danger in the threat.
        fewest: each episode begins with a number of obstacles drawn from `fewest` to
            `num_obstacles`, so that a learner meets sparse rooms as well; by default with all.
        wall_horizon: steps after which a rollout of a wall point's threat is cut.
        obstacle_horizon: steps after which a rollout of an obstacle's threat is cut.
        fidelity: "released" rounds progress to whole numbers, relocates obstacles that leave the
            room or enter a square safety zone, and rewards the goal even if it is reached in a
            crash; "paper" does not, its safety zones are quarter circles, and such obstacles
            disappear.
        baseline: "paper" draws accelerations and turns at random; "plans" brakes, at once or after
            driving on or backing off, straight on or turning.

    Raises:
        ValueError: a value is out of range.
    """
    one_of("fidelity", fidelity, contract.FIDELITIES)
    one_of("baseline", baseline, contract.BASELINES)
    positive("time_limit", time_limit, most=10**9, integer=True)
    number("radius", radius, above=least_radius(SPACING, SPEEDS[-1]), most=0.2)
    # Smaller rooms may have no place at `CLEARANCE` from the vehicle.
    room = number("room", room, least=2.0, most=MOST_ROOM)
    fitting = int((room / (2 * radius)) ** 2)  # how many fit side by side
    number("num_obstacles", num_obstacles, least=1, most=fitting, integer=True)
    positive("beta", beta, most=1.0)
    fewest = num_obstacles if fewest is None else fewest
    number("fewest", fewest, least=0, most=num_obstacles, integer=True)
    positive("wall_horizon", wall_horizon, most=FARTHEST, integer=True)
    positive("obstacle_horizon", obstacle_horizon, most=100, integer=True)
    plans = baseline == "plans"
    body = VehicleModel(
        actions=control_table(ACCELERATIONS, TURNS),
        baseline=make_plans(
            (TURNS[0], 0.0, TURNS[-1]),
            (SPEEDS[-1], SPEEDS[0]),
            EVADING,
            ACCELERATIONS[-1],
            SPEEDS[-1],
        )
        if plans
        else independent_controls(
            ACCELERATIONS, (0.2, 0.6, 0.2), (TURNS[0], 0.0, TURNS[-1]), (0.2, 0.6, 0.2)
        ),
        speeds=jnp.asarray(SPEEDS, float),
    )
    behaviour = independent_controls(
        ACCELERATIONS, (0.2, 0.6, 0.2), OBSTACLE_TURNS, (0.2, 0.2, 0.2, 0.2, 0.2)
    )
    wall = WallPoint.create(body, radius, wall_horizon)
    obstacle = MovingObstacle.create(
        body, jnp.asarray(OBSTACLE_SPEEDS, float), behaviour, 2 * radius, obstacle_horizon
    )
    walls = wall_points(room)
    return Params(
        body=body,
        wall=wall,
        obstacle=obstacle,
        start=make_vehicle((0.2, 0.2), 0.0, 0.0),
        goal=jnp.asarray((room - EXIT / 2, room), float),
        walls=sensing.distance_field(walls, radius) if plans else None,
        walls_in_view=sensing.points_within(walls, 1.0, 0.2),
        walls_in_contact=sensing.points_within(walls, radius, 0.1),
        walls_in_reach=sensing.points_within(walls, wall.window.farthest, 0.2),
        time_limit=jnp.asarray(time_limit, jnp.int32),
        stop_speed=jnp.asarray(0.005, float),
        radius=jnp.asarray(radius, float),
        beta=jnp.asarray(beta, float),
        fewest=jnp.asarray(fewest, jnp.int32),
        room=jnp.asarray(room, float),
        num_obstacles=num_obstacles,
        fidelity=fidelity,
    )


def _progress(body: Vehicle, params: Params) -> Array:
    """Returns -20 times the distance to the goal, (); rounded in "released"."""
    progress = -20 * jnp.sqrt(squared_distance(params.goal, body.position))
    return jnp.round(progress) if params.fidelity == "released" else progress


def start_at(body: Vehicle, obstacles: Vehicle, params: Params) -> State:
    """Returns a state at time 0 with vehicle and obstacles in given places.

    Args:
        body: state of the agent's vehicle.
        obstacles: (N,) states of the obstacles, all present.
        params: the task's parameters.
    """
    return State(
        body=body,
        obstacles=obstacles,
        present=jnp.ones(obstacles.speed.shape, bool),
        progress=_progress(body, params),
        time=jnp.asarray(0, jnp.int32),
    )


def _anywhere(key: Array, params: Params) -> Vehicle:
    """Draws an obstacle anywhere in the room, with any heading and any of its speeds."""
    speeds = params.obstacle.speeds
    uniform = jax.random.uniform(key, (4,), speeds.dtype)
    return make_vehicle(
        params.radius + uniform[:2] * (params.room - 2 * params.radius),
        (2 * uniform[2] - 1) * jnp.pi,
        speeds[(uniform[3] * len(speeds)).astype(jnp.int32)],
    )


def _appear(key: Array, body: Vehicle, needed: Array, params: Params, block: int) -> Vehicle:
    """Draws places for obstacles, at least `CLEARANCE` away from the agent's vehicle.

    The suitable ones of a row of places go to the obstacles in their order, so that the place of
    obstacle n does not depend on how many come after it. Rows that are not needed are meaningless.

    Args:
        key: random key.
        body: state of the agent's vehicle.
        needed: (N,) bool, the obstacles to be placed.
        params: the task's parameters.
        block: number of places that are drawn at once; it changes the speed alone.
    """
    size = needed.shape[0]
    order, wanted = arrays.compact_indices(needed, 1, size)

    def attempt(carry):
        drawn, found, placed = carry
        keys = jax.vmap(jax.random.fold_in, (None, 0))(key, drawn + jnp.arange(block))
        places = jax.vmap(_anywhere, (0, None))(keys, params)
        squared = jax.vmap(squared_distance, (0, None))(places.position, body.position)
        # Written so that a position of nan ends the search; otherwise it would never end.
        free = ~(squared < CLEARANCE**2)
        slots = order.at[found + jnp.cumsum(free) - 1].get(mode="fill", fill_value=size)
        rows = jnp.where(free, slots, size)
        placed = jax.tree.map(lambda old, new: old.at[rows].set(new, mode="drop"), placed, places)
        return drawn + block, found + jnp.sum(free), placed

    blank = jax.tree.map(lambda a: jnp.zeros((size, *a.shape), a.dtype), body)
    begin = (jnp.asarray(0), jnp.asarray(0), blank)
    return jax.lax.while_loop(lambda c: c[1] < wanted, attempt, begin)[2]


def reset(key: Array, params: Params) -> State:
    """Draws a start: the vehicle in its corner, and obstacles at least `CLEARANCE` away from it.

    Args:
        key: random key.
        params: the task's parameters.
    """
    needed = jnp.ones(params.num_obstacles, bool)
    placed = _appear(key, params.start, needed, params, params.num_obstacles)
    # A copy: callers may give a state's memory away, and the parameters' must stay.
    state = start_at(jax.tree.map(jnp.copy, params.start), placed, params)
    count_key = jax.random.fold_in(key, COUNT)
    count = jax.random.randint(count_key, (), params.fewest, params.num_obstacles + 1)
    return state.replace(present=jnp.arange(params.num_obstacles) < count)


def _out_of_place(position: Array, params: Params) -> Array:
    """Returns whether an obstacle at `position` (2,) has left the room or entered a safety zone."""
    low, high = params.radius, params.room - params.radius
    outside = jnp.any((position <= low) | (position >= high))
    corners = params.room * jnp.asarray([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]], position.dtype)
    offset = jnp.abs(position[None] - corners)
    if params.fidelity == "released":
        in_zone = jnp.any(jnp.all(offset < ZONE, axis=-1))
    else:
        in_zone = jnp.any(jnp.sum(jnp.square(offset), axis=-1) < ZONE**2)
    return outside | in_zone


def draw(key: Array, state: State, action: Array, params: Params) -> Draws:
    """Draws the random numbers of a step.

    Those of obstacle n do not depend on the number of obstacles, since JAX's (partitionable) draws
    depend only on the key and the position in the array.

    Args:
        key: random key.
        state: the state before the step.
        action: () int, or (2,) float, as for `VehicleModel.control`.
        params: the task's parameters.
    """
    drive, place = jax.random.split(key)
    controls = params.obstacle.draw(drive, state.present.shape)
    # Obstacles appear at a distance from where the agent's vehicle will be after the step.
    body = _move_agent(state, action, params)
    moved = _move_obstacles(state, controls, params)
    needed = jax.vmap(_out_of_place, (0, None))(moved.position, params)
    block = 1 + params.num_obstacles // 64  # few are needed at a time
    return Draws(controls=controls, relocated=_appear(place, body, needed, params, block))


def _move_agent(state: State, action: Array, params: Params) -> Vehicle:
    return params.body.step(state.body, params.body.control(action))


def _move_obstacles(state: State, controls: Control, params: Params) -> Vehicle:
    return jax.vmap(params.obstacle.step, (0, None, 0))(state.obstacles, state.body, controls)


def transition(
    state: State, action: Array, draws: Draws, params: Params
) -> tuple[State, contract.Outcome]:
    """Makes one transition with given random numbers: the deterministic part of `step`.

    The reward (appendix F) is 20 times the distance gained towards the goal, plus 10 at the goal,
    minus 0.05, minus another 0.05 where the vehicle is almost at rest. A step that crosses the exit
    in a crash is at the goal as well in "released", and not in "paper".

    Args:
        state: the state before.
        action: () int, or (2,) float, as for `VehicleModel.control`.
        draws: the random numbers of the step.
        params: the task's parameters.

    Returns:
        The state after, and the step's outcome.
    """
    body = _move_agent(state, action, params)
    obstacles = _move_obstacles(state, draws.controls, params)
    gone = jax.vmap(_out_of_place, (0, None))(obstacles.position, params)
    present = state.present
    if params.fidelity == "released":
        obstacles = jax.vmap(arrays.select)(gone, draws.relocated, obstacles)
    else:
        present = present & ~gone
    reached = State(
        body=body,
        obstacles=obstacles,
        present=present,
        progress=_progress(body, params),
        time=state.time + 1,
    )
    hit = collisions(reached, params)
    crashed = hit["wall"] | hit["obstacle"]
    goal = body.position[1] > params.room
    if params.fidelity == "paper":
        goal = goal & ~crashed
    stopped = jnp.abs(body.speed) < params.stop_speed
    reward = reached.progress - state.progress - 0.05
    reward = reward - jnp.where(stopped, 0.05, 0.0) + jnp.where(goal, 10.0, 0.0)
    terminated, truncated = contract.ended(crashed | goal, reached.time, params.time_limit)
    return reached, contract.Outcome(
        reward=reward,
        danger=crashed.astype(reward.dtype),
        terminated=terminated,
        truncated=truncated,
        goal=goal,
    )


def step(key: Array, state: State, action: Array, params: Params) -> tuple[State, contract.Outcome]:
    """Makes one transition: vehicle and obstacles move, and obstacles out of place are relocated.

    Args:
        key: random key.
        state: the state before.
        action: () int, or (2,) float, as for `VehicleModel.control`.
        params: the task's parameters.

    Returns:
        The state after, and the step's outcome.
    """
    return transition(state, action, draw(key, state, action, params), params)


def without_moving_hazards(state: State) -> State:
    """Returns the state without obstacles.

    A single row, not present, remains, so that the step's arrays are not empty.

    Args:
        state: any state.
    """
    one = jax.tree.map(lambda a: a[:1], state.obstacles)
    return state.replace(obstacles=one, present=jnp.zeros(1, bool))


def mixed_start(key: Array, start: State, fresh: State) -> State:
    """Returns a start state with some of its obstacles taken from another.

    Args:
        key: random key.
        start: a start state.
        fresh: another one, with as many obstacles.
    """
    taken = jax.random.bernoulli(key, optional.RENEWED, start.present.shape)
    obstacles, present = jax.vmap(arrays.select)(
        taken, (fresh.obstacles, fresh.present), (start.obstacles, start.present)
    )
    return start.replace(obstacles=obstacles, present=present)


def _seen_obstacles(state: State) -> Array:
    """Returns the nearest obstacles, (8, 4): x, y and heading in the body's frame, and speed."""
    body = state.body
    missing = max(0, SEEN_OBSTACLES - state.present.shape[0])
    pad = lambda a: jnp.pad(a, ((0, missing),) + ((0, 0),) * (a.ndim - 1))  # noqa: E731
    others, present = jax.tree.map(pad, (state.obstacles, state.present))
    # Obstacles that do not exist stand at UNSEEN (in the world's frame), heading the opposite way.
    offset = others.position - body.position[None]
    offset = jnp.where(present[:, None], offset, jnp.asarray(UNSEEN, offset.dtype)[None])
    facing = jnp.where(present[:, None], others.heading, -body.heading[None])
    speed = jnp.where(present, others.speed, body.speed)
    rows = jnp.concatenate([offset, facing, speed[:, None]], axis=-1)
    nearest = arrays.smallest(jnp.sum(jnp.square(offset), axis=-1), SEEN_OBSTACLES)
    seen = rows.at[nearest].get(mode="clip")
    local = to_body_frame(seen[:, :2], body.heading)
    turn = angle_of(to_body_frame(seen[:, 2:4], body.heading))
    return jnp.concatenate([local, turn[:, None], seen[:, 4:]], axis=-1)


def observe(state: State, params: Params) -> Array:
    """Returns the observation of a state.

    Args:
        state: the state.
        params: the task's parameters.

    Returns:
        (396,) LIDAR distances of the walls (360), the 8 nearest obstacles (32), x, y, the heading's
        angle in radians, the speed.
    """
    body = state.body
    points = params.walls_in_view.near(body.position)
    scan = sensing.lidar(points, body.position, body.heading, LIDAR_BINS)
    pose = jnp.stack([angle_of(body.heading), body.speed])
    return jnp.concatenate([scan, _seen_obstacles(state).reshape(-1), body.position, pose])


def hazards(state: State, params: Params) -> dict[str, contract.Hazards]:
    """Returns the wall points near the vehicle, and all obstacles; under plans the obstacles alone.

    Args:
        state: the state.
        params: the task's parameters.
    """
    found = {"obstacle": contract.Hazards(state.obstacles, state.present)}
    if isinstance(params.body.baseline, Plans):
        return found
    points = params.walls_in_reach.near(state.body.position)
    return {"wall": contract.Hazards(points, points[:, 0] < sensing.FAR), **found}


def clearance(position: Array, params: Params) -> Array:
    """Returns a lower bound of the distance left between the vehicle and the walls, () room units.

    Args:
        position: (2,) of the vehicle.
        params: the task's parameters, with plans as baseline policies.
    """
    assert params.walls is not None
    return params.walls(position) - params.wall.radius


def collisions(state: State, params: Params) -> dict[str, Array]:
    """Returns whether a wall or an obstacle is being hit, () bool under "wall" and "obstacle".

    Args:
        state: the state.
        params: the task's parameters.
    """
    points = params.walls_in_contact.near(state.body.position)
    walls = jax.vmap(params.wall.hits, (None, 0))(state.body, points)
    others = jax.vmap(params.obstacle.hits, (None, 0))(state.body, state.obstacles)
    return {"wall": jnp.any(walls), "obstacle": jnp.any(others & state.present)}


def sub_rmdps(params: Params) -> dict[str, SubRMDP]:
    """Returns the sub-R-MDPs of the vehicle with a wall point (not under plans) and an obstacle.

    Args:
        params: the task's parameters.
    """
    sources = {"wall": params.wall, "obstacle": params.obstacle}
    if isinstance(params.body.baseline, Plans):
        del sources["wall"]
    return {
        kind: SubRMDP(body=params.body, source=source, beta=params.beta)
        for kind, source in sources.items()
    }


def num_actions(params: Params) -> int:
    """Returns the number of actions: 3 accelerations times 5 turns.

    Args:
        params: the task's parameters.
    """
    return params.body.actions.acceleration.shape[-1]
