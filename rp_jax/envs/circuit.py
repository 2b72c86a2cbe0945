"""Circuit: drive as far as possible along a walled track in 200 steps (paper, appendix F)."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax import sensing
from rp_jax.envs import base, tracks
from rp_jax.hazards import SubRMDP, WallPoint
from rp_jax.kinematics import (
    AgentModel,
    Plans,
    Vehicle,
    angle_of,
    control_table,
    independent_controls,
    make_plans,
    make_vehicle,
    rotate,
    to_ego,
)
from rp_jax.validate import number, one_of, positive

ACCELERATIONS = (-0.02, 0.0, 0.02)  # room units / step^2
TURNS = (-0.15, -0.05, 0.0, 0.05, 0.15)  # radians / step
SPEEDS = tuple(round(0.02 * k, 2) for k in range(-2, 6))  # -.04 .. .1 room units / step
LIDAR_BINS = 360
SCALE: tuple[float, ...] = (1.0, 1.0, 1.0, 10.0)  # of x, y, bend, speed, for learners


class State(struct.PyTreeNode):
    """Where the vehicle is and how far it has come."""

    agent: Vehicle
    index: Array  # () int32, of the nearest centre point
    time: Array  # () int32, steps since the start
    lost: Array  # () bool, x and y are not observed


class Params(struct.PyTreeNode):
    """Build by `make_params`, anew for another track, radius, speed or horizon: tables follow
    from them. `time_limit`, `stop_speed`, `beta` and `lost` can be replaced, or swept by `vmap`."""

    agent: AgentModel
    wall: WallPoint
    track: tracks.Track
    walls: sensing.DistanceField | None  # for plans
    time_limit: Array  # () int32, steps
    stop_speed: Array  # () slower than this costs 1
    beta: Array  # () discount of danger
    lost: Array  # () chance that x and y are not observed in an episode
    fidelity: str = struct.field(pytree_node=False, default="released")


def make_params(
    track: str | tracks.TrackPlan = "default",
    *,
    time_limit: int = 200,
    radius: float = 0.1,
    horizon: int = 5,
    beta: float = 0.999,
    fidelity: str = "released",
    baseline: str = "paper",
    lost: float = 0.0,
) -> Params:
    """The task's parameters, checked.

    Args:
        track: "default", "narrowed", "circle", or a `TrackPlan` of one's own.
        time_limit: steps of an episode.
        radius: of the vehicle, room units.
        horizon: steps after which a rollout of the threat is cut.
        beta: discount of danger in the threat.
        fidelity: "released" earns nothing for crossing the lap line, as the published numbers
            did; "paper" counts it as any other progress.
        baseline: "paper" draws accelerations and turns at random; "plans" brakes, with each turn.
        lost: chance that x and y read 0 throughout an episode. An agent that learned with some
            such episodes can be used on other tracks, where places learned by heart mislead.

    Raises:
        ValueError: a value is out of range, or the track cannot be driven.
    """
    one_of("fidelity", fidelity, base.FIDELITIES)
    one_of("baseline", baseline, base.BASELINES)
    positive("time_limit", time_limit, most=10**9, integer=True)
    positive("horizon", horizon, most=base.FARTHEST, integer=True)
    number("radius", radius, above=base.least_radius(0.0, SPEEDS[-1]), most=tracks.LARGEST)
    positive("beta", beta, most=1.0)
    number("lost", lost, least=0, most=1)
    if not isinstance(track, tracks.TrackPlan):
        track = tracks.PLANS[one_of("track", track, tracks.PLANS)]()
    plans = baseline == "plans"
    agent = AgentModel(
        actions=control_table(ACCELERATIONS, TURNS),
        baseline=make_plans(TURNS, (), 0, ACCELERATIONS[-1], SPEEDS[-1])
        if plans
        else independent_controls(
            ACCELERATIONS, (0.2, 0.6, 0.2), (TURNS[0], 0.0, TURNS[-1]), (0.2, 0.6, 0.2)
        ),
        speeds=jnp.asarray(SPEEDS, float),
    )
    wall = WallPoint.create(agent, radius, horizon)
    made = tracks.make_track(track, radius, SPEEDS[-1], wall.window.farthest)
    return Params(
        agent=agent,
        wall=wall,
        track=made,
        walls=sensing.distance_field(np.asarray(made.walls), radius) if plans else None,
        time_limit=jnp.asarray(time_limit, jnp.int32),
        stop_speed=jnp.asarray(0.005, float),
        beta=jnp.asarray(beta, float),
        lost=jnp.asarray(lost, float),
        fidelity=fidelity,
    )


def start_at(agent: Vehicle, params: Params) -> State:
    """A state with the vehicle anywhere, at time 0; lost only where all are."""
    return State(
        agent=agent,
        index=params.track.nearest_centre.nearest(agent.position),
        time=jnp.asarray(0, jnp.int32),
        lost=params.lost >= 1,
    )


def demo_start(params: Params) -> State:
    """At the first centre point, along the track, at rest: the start of figure 6."""
    track = params.track
    return start_at(make_vehicle(track.centre[0], angle_of(track.direction[0]), 0.0), params)


def reset(key: Array, params: Params) -> State:
    """A random centre point, up to 45 degrees off the track's direction, at rest."""
    where, turn, instrument = jax.random.split(key, 3)
    i = jax.random.randint(where, (), 0, params.track.centre.shape[0])
    angle = jax.random.uniform(turn, (), float, -jnp.pi / 4, jnp.pi / 4)
    heading = rotate(params.track.direction[i], jnp.stack([jnp.cos(angle), jnp.sin(angle)]))
    position = params.track.centre[i]
    state = start_at(Vehicle(position=position, heading=heading, speed=jnp.zeros(())), params)
    return state.replace(lost=jax.random.bernoulli(instrument, params.lost))


def step(key: Array, state: State, action: Array, params: Params) -> tuple[State, base.Outcome]:
    """One transition; `key` is not used, since nothing here is random.

    The reward is the number of centre points passed, less 1 when (almost) standing still.
    """
    del key
    control = params.agent.control(action)
    reached = start_at(params.agent.step(state.agent, control), params)
    reached = reached.replace(time=state.time + 1, lost=state.lost)
    crashed = causes(reached, params)["wall"]
    n = params.track.centre.shape[0]
    passed = reached.index - state.index
    if params.fidelity == "released":
        progress = jnp.where(jnp.abs(passed) >= n // 4, 0, passed)
    else:
        progress = (passed + n // 2) % n - n // 2
    stopped = jnp.abs(reached.agent.speed) < params.stop_speed
    reward = progress.astype(params.stop_speed.dtype) - stopped
    terminated, truncated = base.ended(crashed, reached.time, params.time_limit)
    return reached, base.Outcome(
        reward=reward,
        danger=crashed.astype(reward.dtype),
        terminated=terminated,
        truncated=truncated,
        goal=jnp.zeros_like(crashed),
    )


def alone(state: State) -> State:
    """The state without hazards that move: there are none."""
    return state


def observe(state: State, params: Params) -> Array:
    """(364,) LIDAR (360), x, y (0 if lost), direction of the track from the heading, speed."""
    agent, track = state.agent, params.track
    points = track.walls_in_view.near(agent.position)
    scan = sensing.lidar(points, agent.position, agent.heading, LIDAR_BINS, tracks.VIEW)
    bend = angle_of(to_ego(track.onward[state.index], agent.heading))
    place = jnp.where(state.lost, 0.0, agent.position)
    return jnp.concatenate([scan, place, jnp.stack([bend, agent.speed])])


def hazards(state: State, params: Params) -> dict[str, base.Hazards]:
    """The wall points near the vehicle; none under plans, which take all walls together."""
    if isinstance(params.agent.baseline, Plans):
        return {}
    points = params.track.walls_in_reach.near(state.agent.position)
    return {"wall": base.Hazards(points, points[:, 0] < sensing.FAR)}


def causes(state: State, params: Params) -> dict[str, Array]:
    """Whether the wall is being hit."""
    points = params.track.walls_in_contact.near(state.agent.position)
    return {"wall": jnp.any(jax.vmap(params.wall.hits, (None, 0))(state.agent, points))}


def clearance(position: Array, params: Params) -> Array:
    """() room left between the vehicle at `position` (2,) and the walls; never too much."""
    assert params.walls is not None
    return params.walls(position) - params.wall.radius


def sub_rmdps(params: Params) -> dict[str, SubRMDP]:
    """One agent and one wall point; none under plans."""
    if isinstance(params.agent.baseline, Plans):
        return {}
    return {"wall": SubRMDP(agent=params.agent, source=params.wall, beta=params.beta)}


def num_actions(params: Params) -> int:
    """15 = 3 accelerations x 5 turns."""
    return params.agent.actions.acceleration.shape[-1]
