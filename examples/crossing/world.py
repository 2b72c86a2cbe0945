"""A car on a road that pedestrians cross, between two rows of parked cars."""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax import arrays
from rp_jax.dynamics import (
    Vehicle,
    VehicleModel,
    control_table,
    independent_controls,
    make_vehicle,
    squared_distance,
    to_body_frame,
)
from rp_jax.envs import contract
from rp_jax.hazards import SubRMDP, WallPoint, Window, padded_window, sample_speed
from rp_jax.validate import number

# --- the agent ---

ACCELERATIONS = (-0.02, 0.0, 0.02)  # lengths / step^2
TURNS = (-0.1, 0.0, 0.1)  # radians / step


def make_agent() -> VehicleModel:
    """Returns a car that never reverses; while threats are measured, it mostly brakes."""
    return VehicleModel(
        actions=control_table(ACCELERATIONS, TURNS),
        baseline=independent_controls(ACCELERATIONS, (0.7, 0.2, 0.1), TURNS, (0.2, 0.6, 0.2)),
        speeds=jnp.asarray([0.0, 0.02, 0.04, 0.06, 0.08, 0.1]),
    )


# --- the hazards ---


class Walker(struct.PyTreeNode):
    """A pedestrian."""

    position: Array  # (2,)
    way: Array  # (2,) unit vector, where it walks to


class Pedestrian(struct.PyTreeNode):
    """Walks on, stands still or turns round, as it pleases; a `rp_jax.hazards.HazardSource`."""

    distance: Array  # () centres nearer than this have met
    pace: Array  # () of those who walk
    window: Window
    horizon: int = struct.field(pytree_node=False, default=8)

    def draw(self, key: Array, shape: tuple[int, ...] = ()) -> Array:
        """Draws (..., 2) numbers: whether it walks, and whether it turns round."""
        return jax.random.uniform(key, (*shape, 2))

    def step(self, hazard: Walker, body: Vehicle, noise: Array) -> Walker:
        """Walks in 7 of 10 steps, but into no car that stands; turns round in 1 of 20."""
        way = jnp.where(noise[1] < 0.05, -hazard.way, hazard.way)
        moved = Walker(hazard.position + self.pace * hazard.way, way)
        stays = (noise[0] > 0.7) | ((body.speed <= 0) & self.hits(body, moved))
        return moved.replace(position=jnp.where(stays, hazard.position, moved.position))

    def hits(self, body: Vehicle, hazard: Walker) -> Array:
        """Returns whether the centres are nearer than `distance`."""
        return squared_distance(hazard.position, body.position) < jnp.square(self.distance)

    def in_reach(self, body: Vehicle, hazard: Walker) -> Array:
        """Returns whether it is in the window."""
        return self.window.contains(to_body_frame(hazard.position - body.position, body.heading))

    def features(self, body: Vehicle, hazard: Walker) -> Array:
        """Returns (5,), in the car's frame: position (2), way (2); the car's speed."""
        relative = to_body_frame(hazard.position - body.position, body.heading)
        way = to_body_frame(hazard.way, body.heading)
        return jnp.concatenate([relative, way, body.speed[None]])

    def mirrored(self, features: Array) -> Array:
        """Returns the features with left and right exchanged."""
        return features * jnp.broadcast_to(jnp.asarray([1.0, -1.0, 1.0, -1.0, 1.0]), features.shape)

    def sample(self, key: Array, model: VehicleModel) -> tuple[Vehicle, Walker]:
        """Draws a walker anywhere in the window, walking anywhere, and a car of any speed."""
        where, turn, fast = jax.random.split(key, 3)
        angle = jax.random.uniform(turn, (), float, -jnp.pi, jnp.pi)
        way = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        car = make_vehicle(jnp.zeros(2), 0.0, sample_speed(fast, model.speeds))
        return car, Walker(self.window.sample(where), way)

    def state_of(self, features: Array) -> tuple[Vehicle, Walker]:
        """Returns the pair with these features, the car at the origin."""
        way = features[2:4] / jnp.linalg.norm(features[2:4])
        return make_vehicle(jnp.zeros(2), 0.0, features[4]), Walker(features[:2], way)


# --- the world ---

LENGTH = 4.0  # of the road, along x
KERB = 0.6  # parked cars stand along y = +-KERB, a car every GAP
GAP = 0.4
PAVEMENT = 0.8  # pedestrians turn round at y = +-PAVEMENT
SEEN = 4  # pedestrians observed
SCALE: tuple[float, ...] = (0.25, 2.0, 1.0, 1.0, 10.0) + (1.0, 1.0, 1.0, 1.0) * SEEN


class State(struct.PyTreeNode):
    """The car and the pedestrians."""

    body: Vehicle
    walkers: Walker  # leading axis (N,)
    time: Array  # () int32


class Params(struct.PyTreeNode):
    """Build by `make_params`."""

    body: VehicleModel
    pedestrian: Pedestrian
    parked: WallPoint
    time_limit: Array  # () int32, steps
    beta: Array  # () discount of danger
    pedestrians: int = struct.field(pytree_node=False, default=6)


@jax.ensure_compile_time_eval()  # tables of plain numbers, also where a caller is being traced
def make_params(pedestrians: int = 6, time_limit: int = 100) -> Params:
    """Returns a road with so many pedestrians.

    Raises:
        ValueError: a value is out of range.
    """
    number("pedestrians", pedestrians, least=1, most=100, integer=True)
    number("time_limit", time_limit, least=1, most=10**9, integer=True)
    body, distance, pace, horizon = make_agent(), 0.15, 0.03, 8
    pedestrian = Pedestrian(
        distance=jnp.asarray(distance, float),
        pace=jnp.asarray(pace, float),
        window=padded_window(body, horizon, distance + horizon * pace),
        horizon=horizon,
    )
    return Params(
        body=body,
        pedestrian=pedestrian,
        parked=WallPoint.create(body, radius=0.3, horizon=5),
        time_limit=jnp.asarray(time_limit, jnp.int32),
        beta=jnp.asarray(0.999, float),
        pedestrians=pedestrians,
    )


def reset(key: Array, params: Params) -> State:
    """Returns the car at rest where the road begins, and pedestrians anywhere ahead."""
    where, side = jax.random.split(key)
    count = params.pedestrians
    low, high = jnp.asarray([0.8, -PAVEMENT]), jnp.asarray([LENGTH, PAVEMENT])
    position = jax.random.uniform(where, (count, 2), float, low[None], high[None])
    up = jnp.where(jax.random.bernoulli(side, 0.5, (count,)), 1.0, -1.0)
    way = jnp.stack([jnp.zeros(count), up], axis=-1)
    car = make_vehicle(jnp.zeros(2), 0.0, 0.0)
    return State(body=car, walkers=Walker(position, way), time=jnp.asarray(0, jnp.int32))


def step(key: Array, state: State, action: Array, params: Params) -> tuple[State, contract.Outcome]:
    """Moves all; 10 for each unit of way made, -.05 a step, 5 at the end of the road."""
    source = params.pedestrian

    def walk(n: Array, walker: Walker) -> Walker:
        moved = source.step(walker, state.body, source.draw(jax.random.fold_in(key, n)))
        # The world's business: the sub-R-MDP knows nothing of pavements.
        back = jnp.sign(moved.position[1]) * jnp.asarray([0.0, -1.0])
        return moved.replace(way=jnp.where(jnp.abs(moved.position[1]) > PAVEMENT, back, moved.way))

    reached = State(
        body=params.body.step(state.body, params.body.control(action)),
        walkers=jax.vmap(walk)(jnp.arange(params.pedestrians), state.walkers),
        time=state.time + 1,
    )
    hit = contract.hits(sub_rmdps(params), reached.body, hazards(reached, params))
    crashed = hit["pedestrian"] | hit["parked"]
    goal = (reached.body.position[0] > LENGTH) & ~crashed
    way = reached.body.position[0] - state.body.position[0]
    terminated, truncated = contract.ended(crashed | goal, reached.time, params.time_limit)
    return reached, contract.Outcome(
        reward=10.0 * way - 0.05 + jnp.where(goal, 5.0, 0.0),
        danger=crashed.astype(way.dtype),
        terminated=terminated,
        truncated=truncated,
        goal=goal,
    )


def observe(state: State, params: Params) -> Array:
    """Returns (21,): position (2), heading (2) and speed; of 4 pedestrians, the nearest first,
    position and way in the car's frame, at (3, 0) where there are fewer."""
    car, n = state.body, params.pedestrians
    see = lambda walker: params.pedestrian.features(car, walker)[:4]  # noqa: E731
    rows = jax.vmap(see)(state.walkers)
    order = arrays.ranks(squared_distance(state.walkers.position, car.position[None]))
    blank = jnp.tile(jnp.asarray([[3.0, 0.0, 0.0, 0.0]], rows.dtype), (max(n, SEEN), 1))
    nearest = blank.at[order].set(rows)[:SEEN]
    return jnp.concatenate([car.position, car.heading, car.speed[None], nearest.reshape(-1)])


def hazards(state: State, params: Params) -> dict[str, contract.Hazards]:
    """Returns all pedestrians, and the parked cars near by."""
    along = GAP * (jnp.round(state.body.position[0] / GAP) + jnp.arange(-3.0, 4.0))
    sides = [jnp.stack([along, jnp.full(7, y, along.dtype)], axis=-1) for y in (KERB, -KERB)]
    return {
        "pedestrian": contract.Hazards(state.walkers, jnp.ones(params.pedestrians, bool)),
        "parked": contract.Hazards(jnp.concatenate(sides), jnp.ones(14, bool)),
    }


def sub_rmdps(params: Params) -> dict[str, SubRMDP]:
    """Returns one car and one pedestrian; one car and one parked car."""
    return {
        "pedestrian": SubRMDP(body=params.body, source=params.pedestrian, beta=params.beta),
        "parked": SubRMDP(body=params.body, source=params.parked, beta=params.beta),
    }
