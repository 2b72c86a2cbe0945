"""Jam: leave a room through its exit among randomly moving obstacles (paper, appendix F)."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax import sensing
from rp_jax.envs import base
from rp_jax.hazards import MovingObstacle, SubRMDP, WallPoint
from rp_jax.kinematics import (
    AgentModel,
    Control,
    Plans,
    Vehicle,
    angle_of,
    control_table,
    independent_controls,
    make_plans,
    make_vehicle,
    squared_distance,
    to_ego,
)
from rp_jax.validate import number, one_of, positive

ROOM = 3.0  # side of the square room
EXIT = (2.2, 3.0)  # gap in the top wall
SPACING = 0.02  # of the walls' points
ACCELERATIONS = (-0.02, 0.0, 0.02)  # room units / step^2
TURNS = (-0.3, -0.1, 0.0, 0.1, 0.3)  # radians / step
SPEEDS = tuple(round(0.02 * k, 2) for k in range(-5, 6))  # -.1 .. .1 room units / step
OBSTACLE_SPEEDS = (0.0, 0.02, 0.04, 0.06)
OBSTACLE_TURNS = (-0.15, -0.05, 0.0, 0.05, 0.15)
CLEARANCE = 1.0  # obstacles appear at least this far from the agent
ZONE = 0.5  # side (released) or radius (paper) of the corner safety zones
LIDAR_BINS = 360
SEEN_OBSTACLES = 8
SCALE: tuple[float, ...] = (1.0, 1.0, 1.0, 10.0) * (
    SEEN_OBSTACLES + 1
)  # of x, y, heading, speed, for learners
UNSEEN = (-1.5, -1.51)  # where the observation puts obstacles that do not exist
COUNT = 0xC0DE  # folded into the key of a start for the number of obstacles
EVADING = 3  # steps for which plans drive on or back off before they brake


class State(struct.PyTreeNode):
    """The agent, the obstacles, and the progress made."""

    agent: Vehicle
    obstacles: Vehicle  # leading axis (N,)
    present: Array  # (N,) bool; "paper" obstacles disappear in the safety zones
    progress: Array  # () -20 x distance to the goal (rounded in "released")
    time: Array  # () int32, steps since the start


class Draws(struct.PyTreeNode):
    """All random numbers of one step: feed recorded ones to replay a transition."""

    controls: Control  # (N,) of the obstacles
    relocated: Vehicle  # (N,) where an obstacle that has left the room appears again


class Params(struct.PyTreeNode):
    """Build by `make_params`, anew for another radius, speed or horizon: tables follow from them.
    `start`, `time_limit`, `stop_speed`, `beta` and `fewest` can be replaced, or swept by `vmap`."""

    agent: AgentModel
    wall: WallPoint
    obstacle: MovingObstacle
    start: Vehicle
    goal: Array  # (2,) the point that progress is measured to
    walls: sensing.DistanceField | None  # for plans
    walls_in_view: sensing.PointGrid
    walls_in_contact: sensing.PointGrid
    walls_in_reach: sensing.PointGrid
    time_limit: Array  # () int32, steps
    stop_speed: Array  # () slower than this costs .05
    radius: Array  # () of every vehicle
    beta: Array  # () discount of danger
    fewest: Array  # () int32, obstacles that an episode begins with, at least
    num_obstacles: int = struct.field(pytree_node=False, default=8)
    fidelity: str = struct.field(pytree_node=False, default="released")


def wall_points() -> np.ndarray:
    """(559, 2) the room's walls, a point every SPACING, without the exit."""
    way = np.arange(150) * SPACING
    bottom, left = np.stack([way, 0 * way], 1), np.stack([0 * way, way], 1)
    top = np.stack([way, 0 * way + ROOM], 1)
    right = np.stack([0 * way + ROOM, way], 1)
    walls = np.concatenate([bottom, top[way < EXIT[0] - 1e-9], left, right])
    _, first = np.unique(walls.round(9), axis=0, return_index=True)
    return walls[np.sort(first)]


def make_params(
    num_obstacles: int = 8,
    *,
    time_limit: int = 100,
    radius: float = 0.1,
    beta: float = 0.999,
    fewest: int | None = None,
    wall_horizon: int = 5,
    obstacle_horizon: int = 8,
    fidelity: str = "released",
    baseline: str = "paper",
) -> Params:
    """The task's parameters, checked.

    Args:
        num_obstacles: 8 in the paper; 3 and 15 for transfer.
        time_limit: steps of an episode.
        radius: of every vehicle, room units.
        beta: discount of danger in the threat.
        fewest: each episode begins with a number of obstacles drawn from `fewest` to
            `num_obstacles`, so that a learner meets sparse rooms as well; by default with all.
        wall_horizon: steps after which the threat of a wall point is cut.
        obstacle_horizon: steps after which the threat of an obstacle is cut.
        fidelity: "released" rounds progress to whole points and relocates obstacles that leave
            the room or enter a square safety zone; "paper" does not round, and obstacles
            disappear, in quarter circles.
        baseline: "paper" draws accelerations and turns at random; "plans" brakes, at once or after
            driving on or backing off, straight on or turning.

    Raises:
        ValueError: a value is out of range.
    """
    one_of("fidelity", fidelity, base.FIDELITIES)
    one_of("baseline", baseline, base.BASELINES)
    positive("time_limit", time_limit, most=10**9, integer=True)
    number("radius", radius, above=base.least_radius(SPACING, SPEEDS[-1]), most=0.2)
    room = int((ROOM / (2 * radius)) ** 2)  # how many fit, side by side
    number("num_obstacles", num_obstacles, least=1, most=room, integer=True)
    positive("beta", beta, most=1.0)
    fewest = num_obstacles if fewest is None else fewest
    number("fewest", fewest, least=0, most=num_obstacles, integer=True)
    positive("wall_horizon", wall_horizon, most=base.FARTHEST, integer=True)
    positive("obstacle_horizon", obstacle_horizon, most=100, integer=True)
    plans = baseline == "plans"
    agent = AgentModel(
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
    wall = WallPoint.create(agent, radius, wall_horizon)
    obstacle = MovingObstacle.create(
        agent, jnp.asarray(OBSTACLE_SPEEDS, float), behaviour, 2 * radius, obstacle_horizon
    )
    walls = wall_points()
    return Params(
        agent=agent,
        wall=wall,
        obstacle=obstacle,
        start=make_vehicle((0.2, 0.2), 0.0, 0.0),
        goal=jnp.asarray((2.6, 3.0), float),
        walls=sensing.distance_field(walls, radius) if plans else None,
        walls_in_view=sensing.points_within(walls, 1.0, 0.2),
        walls_in_contact=sensing.points_within(walls, radius, 0.1),
        walls_in_reach=sensing.points_within(walls, wall.window.farthest, 0.2),
        time_limit=jnp.asarray(time_limit, jnp.int32),
        stop_speed=jnp.asarray(0.005, float),
        radius=jnp.asarray(radius, float),
        beta=jnp.asarray(beta, float),
        fewest=jnp.asarray(fewest, jnp.int32),
        num_obstacles=num_obstacles,
        fidelity=fidelity,
    )


def _progress(agent: Vehicle, params: Params) -> Array:
    progress = -20 * jnp.sqrt(squared_distance(params.goal, agent.position))
    return jnp.round(progress) if params.fidelity == "released" else progress


def start_at(agent: Vehicle, obstacles: Vehicle, params: Params) -> State:
    """A state with the agent and the obstacles (N,) anywhere, at time 0."""
    return State(
        agent=agent,
        obstacles=obstacles,
        present=jnp.ones(obstacles.speed.shape, bool),
        progress=_progress(agent, params),
        time=jnp.asarray(0, jnp.int32),
    )


def _anywhere(key: Array, params: Params) -> Vehicle:
    """An obstacle anywhere in the room, with any heading and any of its speeds."""
    speeds = params.obstacle.speeds
    uniform = jax.random.uniform(key, (4,), speeds.dtype)
    return make_vehicle(
        params.radius + uniform[:2] * (ROOM - 2 * params.radius),
        (2 * uniform[2] - 1) * jnp.pi,
        speeds[(uniform[3] * len(speeds)).astype(jnp.int32)],
    )


def _appear(key: Array, agent: Vehicle, needed: Array, params: Params) -> Vehicle:
    """Places (N,) the obstacles that are `needed` (N,) CLEARANCE away from the agent.

    By rejection, one after another: few are needed at a time, and obstacle n's place does not
    depend on how many come after it. Rows that are not needed hold nothing of use.
    """

    def attempt(carry):
        count, left, placed = carry
        place = _anywhere(jax.random.fold_in(key, count), params)
        # Written so that an agent at nan ends the search instead of prolonging it for ever.
        free = ~(squared_distance(place.position, agent.position) < CLEARANCE**2)
        now = (jnp.arange(len(left)) == jnp.argmax(left)) & free
        placed = jax.vmap(base.select, (0, None, 0))(now, place, placed)
        return count + 1, left & ~now, placed

    count = needed.shape[0]
    blank = jax.tree.map(lambda a: jnp.zeros((count, *a.shape), a.dtype), agent)
    return jax.lax.while_loop(lambda c: jnp.any(c[1]), attempt, (0, needed, blank))[2]


def reset(key: Array, params: Params) -> State:
    """The agent in its corner, the obstacles anywhere at least CLEARANCE away from it."""
    needed = jnp.ones(params.num_obstacles, bool)
    state = start_at(params.start, _appear(key, params.start, needed, params), params)
    count_key = jax.random.fold_in(key, COUNT)
    count = jax.random.randint(count_key, (), params.fewest, params.num_obstacles + 1)
    return state.replace(present=jnp.arange(params.num_obstacles) < count)


def _out_of_place(position: Array, params: Params) -> Array:
    """() bool, an obstacle at `position` (2,) has left the room or entered a safety zone."""
    low, high = params.radius, ROOM - params.radius
    outside = jnp.any((position <= low) | (position >= high))
    corners = jnp.asarray([[0.0, 0.0], [0.0, ROOM], [ROOM, 0.0]], position.dtype)
    offset = jnp.abs(position[None] - corners)
    if params.fidelity == "released":
        in_zone = jnp.any(jnp.all(offset < ZONE, axis=-1))
    else:
        in_zone = jnp.any(jnp.sum(jnp.square(offset), axis=-1) < ZONE**2)
    return outside | in_zone


def draw(key: Array, state: State, action: Array, params: Params) -> Draws:
    """The random numbers of the step from `state` under `action`.

    Obstacle n's are the same among any number of obstacles: JAX's (partitionable) draws depend on
    the key and the position alone.
    """
    drive, place = jax.random.split(key)
    controls = params.obstacle.draw(drive, state.present.shape)
    # Obstacles appear away from where the agent will be.
    agent = _move_agent(state, action, params)
    moved = _move_obstacles(state, controls, params)
    needed = jax.vmap(_out_of_place, (0, None))(moved.position, params)
    return Draws(controls=controls, relocated=_appear(place, agent, needed, params))


def _move_agent(state: State, action: Array, params: Params) -> Vehicle:
    return params.agent.step(state.agent, params.agent.control(action))


def _move_obstacles(state: State, controls: Control, params: Params) -> Vehicle:
    return jax.vmap(params.obstacle.step, (0, None, 0))(state.obstacles, state.agent, controls)


def transition(
    state: State, action: Array, draws: Draws, params: Params
) -> tuple[State, base.Outcome]:
    """The deterministic part of `step`: everything, given the random numbers.

    Reward (appendix F): 20 x the way made towards the goal - .05 - .05 when (almost) standing
    still + 10 at the goal.
    """
    agent = _move_agent(state, action, params)
    obstacles = _move_obstacles(state, draws.controls, params)
    gone = jax.vmap(_out_of_place, (0, None))(obstacles.position, params)
    present = state.present
    if params.fidelity == "released":
        obstacles = jax.vmap(base.select)(gone, draws.relocated, obstacles)
    else:
        present = present & ~gone
    reached = State(
        agent=agent,
        obstacles=obstacles,
        present=present,
        progress=_progress(agent, params),
        time=state.time + 1,
    )
    hit = causes(reached, params)
    crashed = hit["wall"] | hit["obstacle"]
    goal = (agent.position[1] > ROOM) & ~crashed
    stopped = jnp.abs(agent.speed) < params.stop_speed
    reward = reached.progress - state.progress - 0.05 - 0.05 * stopped + 10.0 * goal
    terminated, truncated = base.ended(crashed | goal, reached.time, params.time_limit)
    return reached, base.Outcome(
        reward=reward,
        danger=crashed.astype(reward.dtype),
        terminated=terminated,
        truncated=truncated,
        goal=goal,
    )


def step(key: Array, state: State, action: Array, params: Params) -> tuple[State, base.Outcome]:
    """One transition: agent and obstacles move, stray obstacles are relocated, crashes found."""
    return transition(state, action, draw(key, state, action, params), params)


def alone(state: State) -> State:
    """The state without obstacles; a single absent one keeps the step's arrays from being empty."""
    one = jax.tree.map(lambda a: a[:1], state.obstacles)
    return state.replace(obstacles=one, present=jnp.zeros(1, bool))


def _seen_obstacles(state: State) -> Array:
    """(8, 4) the nearest obstacles by distance: x, y, heading in the agent's frame, speed."""
    agent = state.agent
    missing = max(0, SEEN_OBSTACLES - state.present.shape[0])
    pad = lambda a: jnp.pad(a, ((0, missing),) + ((0, 0),) * (a.ndim - 1))  # noqa: E731
    others, present = jax.tree.map(pad, (state.obstacles, state.present))
    # Obstacles that do not exist stand at UNSEEN (world frame), facing the agent's back.
    offset = others.position - agent.position[None]
    offset = jnp.where(present[:, None], offset, jnp.asarray(UNSEEN, offset.dtype)[None])
    facing = jnp.where(present[:, None], others.heading, -agent.heading[None])
    speed = jnp.where(present, others.speed, agent.speed)
    local = to_ego(offset, agent.heading)
    turn = angle_of(to_ego(facing, agent.heading))
    rows = jnp.concatenate([local, turn[:, None], speed[:, None]], axis=-1)
    squared = jnp.sum(jnp.square(offset), axis=-1)
    nearest = base.ranks(squared)
    return jnp.zeros((SEEN_OBSTACLES, 4), rows.dtype).at[nearest].set(rows, mode="drop")


def observe(state: State, params: Params) -> Array:
    """(396,) LIDAR of the walls (360), 8 nearest obstacles (32), x, y, heading angle, speed."""
    agent = state.agent
    points = params.walls_in_view.near(agent.position)
    scan = sensing.lidar(points, agent.position, agent.heading, LIDAR_BINS)
    pose = jnp.stack([angle_of(agent.heading), agent.speed])
    return jnp.concatenate([scan, _seen_obstacles(state).reshape(-1), agent.position, pose])


def hazards(state: State, params: Params) -> dict[str, base.Hazards]:
    """The wall points near the agent, and all obstacles; under plans the obstacles alone."""
    found = {"obstacle": base.Hazards(state.obstacles, state.present)}
    if isinstance(params.agent.baseline, Plans):
        return found
    points = params.walls_in_reach.near(state.agent.position)
    return {"wall": base.Hazards(points, points[:, 0] < sensing.FAR), **found}


def clearance(position: Array, params: Params) -> Array:
    """() room left between the agent at `position` (2,) and the walls; never too much."""
    assert params.walls is not None
    return params.walls(position) - params.wall.radius


def causes(state: State, params: Params) -> dict[str, Array]:
    """Whether the wall or an obstacle is being hit."""
    points = params.walls_in_contact.near(state.agent.position)
    walls = jax.vmap(params.wall.hits, (None, 0))(state.agent, points)
    others = jax.vmap(params.obstacle.hits, (None, 0))(state.agent, state.obstacles)
    return {"wall": jnp.any(walls), "obstacle": jnp.any(others & state.present)}


def sub_rmdps(params: Params) -> dict[str, SubRMDP]:
    """One agent and one wall point (not under plans); one agent and one obstacle."""
    sources = {"wall": params.wall, "obstacle": params.obstacle}
    if isinstance(params.agent.baseline, Plans):
        del sources["wall"]
    return {
        kind: SubRMDP(agent=params.agent, source=source, beta=params.beta)
        for kind, source in sources.items()
    }


def num_actions(params: Params) -> int:
    """15 = 3 accelerations x 5 turns."""
    return params.agent.actions.acceleration.shape[-1]
