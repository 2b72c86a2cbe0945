"""Circuit: drive as far as possible along a walled track in 200 steps (paper, appendix F)."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax.dynamics import (
    Plans,
    Vehicle,
    VehicleModel,
    angle_of,
    control_table,
    independent_controls,
    make_plans,
    make_vehicle,
    rotate,
    to_body_frame,
)
from rp_jax.envs import contract, sensing, tracks, walls
from rp_jax.hazards import SubRMDP, WallPoint
from rp_jax.validate import number, one_of, positive

ACCELERATIONS = (-0.02, 0.0, 0.02)  # room units / step^2
TURNS = (-0.15, -0.05, 0.0, 0.05, 0.15)  # radians / step
SPEEDS = tuple(round(0.02 * k, 2) for k in range(-2, 6))  # -.04 .. .1 room units / step
LIDAR_BINS = 360
SCALE: tuple[float, ...] = (1.0, 1.0, 1.0, 10.0)  # factors of x, y, bend and speed, for learners


class State(struct.PyTreeNode):
    """The vehicle and its progress along the track."""

    body: Vehicle
    index: Array  # () int32, index of the nearest centre point
    time: Array  # () int32, steps since the start
    hide_position: Array  # () bool, x and y are not observed


class Params(struct.PyTreeNode):
    """The task's parameters; to be built by `make_params`.

    Another track, radius, speed or horizon needs new parameters, since tables depend on them. The
    fields `time_limit`, `stop_speed`, `beta` and `hide_position` can be replaced, or swept by
    `vmap`.
    """

    body: VehicleModel
    wall: WallPoint
    track: tracks.Track
    walls: sensing.DistanceField | None  # distance to the walls, where plans need it
    time_limit: Array  # () int32, steps of an episode
    stop_speed: Array  # () a step at less than this speed costs 1
    beta: Array  # () discount of danger in the threat
    hide_position: Array  # () probability that x and y are not observed in an episode
    fidelity: str = struct.field(pytree_node=False, default="released")  # or "paper"


@jax.ensure_compile_time_eval()  # tables of plain numbers, also where a caller is being traced
def make_params(
    track: str | tracks.TrackPlan = "default",
    *,
    time_limit: int = 200,
    radius: float = 0.1,
    horizon: int = 5,
    beta: float = 0.999,
    fidelity: str = "released",
    baseline: str = "paper",
    hide_position: float = 0.0,
) -> Params:
    """Returns the task's parameters, checked.

    Args:
        track: "default", "narrowed", "circle", or a `TrackPlan`.
        time_limit: steps of an episode.
        radius: radius of the vehicle, room units.
        horizon: steps after which a rollout of the threat is cut.
        beta: discount of danger in the threat.
        fidelity: "released" gives no reward for crossing the lap line, as in the runs that made the
            published numbers; "paper" rewards it like any other progress.
        baseline: "paper" draws accelerations and turns at random; "plans" brakes, with each turn.
        hide_position: probability that x and y read 0 throughout an episode. An agent that has seen
            such episodes can be used on other tracks, where positions learned by heart mislead.

    Raises:
        ValueError: a value is out of range, or the track cannot be driven.
    """
    one_of("fidelity", fidelity, contract.FIDELITIES)
    one_of("baseline", baseline, contract.BASELINES)
    positive("time_limit", time_limit, most=10**9, integer=True)
    positive("horizon", horizon, most=walls.FARTHEST, integer=True)
    number("radius", radius, above=walls.least_radius(0.0, SPEEDS[-1]), most=tracks.LARGEST)
    positive("beta", beta, most=1.0)
    number("hide_position", hide_position, least=0, most=1)
    if not isinstance(track, tracks.TrackPlan):
        track = tracks.PLANS[one_of("track", track, tracks.PLANS)]()
    plans = baseline == "plans"
    body = VehicleModel(
        actions=control_table(ACCELERATIONS, TURNS),
        baseline=make_plans(TURNS, (), 0, ACCELERATIONS[-1], SPEEDS[-1])
        if plans
        else independent_controls(
            ACCELERATIONS, (0.2, 0.6, 0.2), (TURNS[0], 0.0, TURNS[-1]), (0.2, 0.6, 0.2)
        ),
        speeds=jnp.asarray(SPEEDS, float),
    )
    wall = WallPoint.create(body, radius, horizon)
    made = tracks.make_track(track, radius, SPEEDS[-1], wall.window.farthest)
    return Params(
        body=body,
        wall=wall,
        track=made,
        walls=sensing.distance_field(np.asarray(made.walls), radius) if plans else None,
        time_limit=jnp.asarray(time_limit, jnp.int32),
        stop_speed=jnp.asarray(0.005, float),
        beta=jnp.asarray(beta, float),
        hide_position=jnp.asarray(hide_position, float),
        fidelity=fidelity,
    )


def start_at(body: Vehicle, params: Params) -> State:
    """Returns a state at time 0 with the vehicle in a given place.

    Args:
        body: the vehicle's state.
        params: the task's parameters; the position is hidden only if it is hidden in all episodes.
    """
    return State(
        body=body,
        index=params.track.nearest_centre.nearest(body.position),
        time=jnp.asarray(0, jnp.int32),
        hide_position=params.hide_position >= 1,
    )


def demo_start(params: Params) -> State:
    """Returns the start of figure 6: at rest at the first centre point, along the track.

    Args:
        params: the task's parameters.
    """
    track = params.track
    return start_at(make_vehicle(track.centre[0], angle_of(track.direction[0]), 0.0), params)


def reset(key: Array, params: Params) -> State:
    """Draws a start: at rest at a random centre point, up to 45 degrees off the track's direction.

    Args:
        key: random key.
        params: the task's parameters.
    """
    where, turn, instrument = jax.random.split(key, 3)
    i = jax.random.randint(where, (), 0, params.track.centre.shape[0])
    angle = jax.random.uniform(turn, (), float, -jnp.pi / 4, jnp.pi / 4)
    heading = rotate(params.track.direction[i], jnp.stack([jnp.cos(angle), jnp.sin(angle)]))
    position = params.track.centre[i]
    state = start_at(Vehicle(position=position, heading=heading, speed=jnp.zeros(())), params)
    return state.replace(hide_position=jax.random.bernoulli(instrument, params.hide_position))


def step(key: Array, state: State, action: Array, params: Params) -> tuple[State, contract.Outcome]:
    """Makes one transition, which is deterministic.

    The reward is the number of centre points passed, minus 1 where the vehicle is almost at rest.

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
    reached = start_at(params.body.step(state.body, control), params)
    reached = reached.replace(time=state.time + 1, hide_position=state.hide_position)
    crashed = collisions(reached, params)["wall"]
    n = params.track.centre.shape[0]
    passed = reached.index - state.index
    if params.fidelity == "released":
        progress = jnp.where(jnp.abs(passed) >= n // 4, 0, passed)
    else:
        progress = (passed + n // 2) % n - n // 2
    stopped = jnp.abs(reached.body.speed) < params.stop_speed
    reward = progress.astype(params.stop_speed.dtype) - jnp.where(stopped, 1.0, 0.0)
    terminated, truncated = contract.ended(crashed, reached.time, params.time_limit)
    return reached, contract.Outcome(
        reward=reward,
        danger=crashed.astype(reward.dtype),
        terminated=terminated,
        truncated=truncated,
        goal=jnp.zeros_like(crashed),
    )


def without_moving_hazards(state: State) -> State:
    """Returns the state unchanged, since no hazard moves.

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
        (364,) LIDAR distances (360), x and y (0 where hidden), the track's direction relative to
        the heading in radians, the speed.
    """
    body, track = state.body, params.track
    points = track.walls_in_view.near(body.position)
    scan = sensing.lidar(points, body.position, body.heading, LIDAR_BINS, tracks.VIEW)
    bend = angle_of(to_body_frame(track.onward[state.index], body.heading))
    place = jnp.where(state.hide_position, 0.0, body.position)
    return jnp.concatenate([scan, place, jnp.stack([bend, body.speed])])


def hazards(state: State, params: Params) -> dict[str, contract.Hazards]:
    """Returns the wall points near the vehicle; none under plans.

    Plans take all walls together, by `clearance`.

    Args:
        state: the state.
        params: the task's parameters.
    """
    if isinstance(params.body.baseline, Plans):
        return {}
    points = params.track.walls_in_reach.near(state.body.position)
    return {"wall": contract.Hazards(points, points[:, 0] < sensing.FAR)}


def collisions(state: State, params: Params) -> dict[str, Array]:
    """Returns whether the vehicle touches a wall, () bool under "wall".

    Args:
        state: the state.
        params: the task's parameters.
    """
    points = params.track.walls_in_contact.near(state.body.position)
    return {"wall": jnp.any(jax.vmap(params.wall.hits, (None, 0))(state.body, points))}


def clearance(position: Array, params: Params) -> Array:
    """Returns a lower bound of the distance left between the vehicle and the walls, () room units.

    Args:
        position: (2,) of the vehicle.
        params: the task's parameters, with plans as baseline policies.
    """
    assert params.walls is not None
    return params.walls(position) - params.wall.radius


def sub_rmdps(params: Params) -> dict[str, SubRMDP]:
    """Returns the sub-R-MDP of the vehicle and one wall point; under plans there is none.

    Args:
        params: the task's parameters.
    """
    if isinstance(params.body.baseline, Plans):
        return {}
    return {"wall": SubRMDP(body=params.body, source=params.wall, beta=params.beta)}


def num_actions(params: Params) -> int:
    """Returns the number of actions: 3 accelerations times 5 turns.

    Args:
        params: the task's parameters.
    """
    return params.body.actions.acceleration.shape[-1]
