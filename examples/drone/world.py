"""A drone with momentum flies along a wall, past pylons and among drifting discs, to a goal."""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax.envs.contract import Hazards, Outcome, ended, hits
from rp_jax.hazards import SubRMDP, Window
from rp_jax.validate import number

ACCELERATION, TOP_SPEED = 0.025, 0.1  # of the drone, at most, on each axis; a step lasts 1
FIELD = (4.0, 2.0)  # discs turn back at its sides; the drone meets a wall at y = 0 alone
PYLONS = ((1.0, 0.5), (1.0, 1.5), (2.0, 1.0), (3.0, 0.5), (3.0, 1.5))
START, GOAL, NEAR, SEEN = (0.3, 1.0), (3.7, 0.7), 0.3, 4  # NEAR: radius of the goal; SEEN: discs


class Motion(struct.PyTreeNode):
    """The state of the drone or of an obstacle: a double integrator, each axis by itself."""

    position: Array  # (2,)
    velocity: Array  # (2,)

    def advance(self, change: Array, top: Array | float) -> "Motion":
        """Moves at the old velocity, then changes it by `change` (2,), up to a top speed."""
        return Motion(self.position + self.velocity, jnp.clip(self.velocity + change, -top, top))


class Brake(struct.PyTreeNode):
    """Brakes to a halt and stays there; a `rp_jax.dynamics.BaselinePolicy`."""

    def draw(self, key: Array, shape: tuple[int, ...] = ()) -> Array:
        """Returns how strong the brakes are, which varies."""
        return jax.random.uniform(key, shape, float, 0.7 * ACCELERATION, ACCELERATION)

    def act(self, body: Motion, noise: Array) -> Array:
        """Returns the acceleration (2,) against the velocity, not beyond a halt."""
        return jnp.clip(-body.velocity, -noise, noise)


class Drone(struct.PyTreeNode):
    """A `rp_jax.dynamics.Body` whose controls are accelerations (2,)."""

    actions: Array  # (9, 2)
    baseline: Brake

    def control(self, action: Array) -> Array:
        """Returns the acceleration of an action."""
        return self.actions[action]

    def step(self, body: Motion, control: Array) -> Motion:
        """Returns the next state."""
        return body.advance(control, TOP_SPEED)


class Obstacle(struct.PyTreeNode):
    """A disc that drifts, or a pylon or wall that stays; a `rp_jax.hazards.HazardSource`."""

    radius: Array | float  # the drone, a point, must not come nearer
    top_speed: Array | float = 0.0
    jitter: Array | float = 0.0  # greatest change of its velocity in a step
    axes: tuple[int, int] = struct.field(pytree_node=False, default=(1, 1))  # (0, 1): a wall
    horizon: int = struct.field(pytree_node=False, default=8)  # longer than it brakes

    def draw(self, key: Array, shape: tuple[int, ...] = ()) -> Array:
        """Returns changes of velocity (..., 2)."""
        return jax.random.uniform(key, (*shape, 2), float, -self.jitter, self.jitter)

    def step(self, hazard: Motion, body: Motion, noise: Array) -> Motion:
        """Returns the next state, whatever the drone does."""
        return hazard.advance(noise, self.top_speed)

    def features(self, body: Motion, hazard: Motion) -> Array:
        """Returns (6,): position from the drone (of a wall, only y), both velocities."""
        relative = (hazard.position - body.position) * jnp.asarray(self.axes, float)
        return jnp.concatenate([relative, body.velocity, hazard.velocity])

    def state_of(self, features: Array) -> tuple[Motion, Motion]:
        """Returns the pair with these features whose drone is at the origin."""
        return Motion(jnp.zeros(2), features[2:4]), Motion(features[:2], features[4:])

    def hits(self, body: Motion, hazard: Motion) -> Array:
        """Returns whether the drone is nearer than `radius`."""
        return jnp.linalg.norm(self.features(body, hazard)[:2]) < self.radius

    def window(self, body: Motion, hazard: Motion) -> Window:
        """Returns where, from the drone, it may be hit within the horizon."""
        own, other = (jnp.stack([-m.velocity, m.velocity]) for m in (body, hazard))
        n = self.horizon
        way = jnp.clip(n * (own + ACCELERATION * (n - 1) / 2), 0.0, n * TOP_SPEED)
        drift = jnp.clip(n * (self.jitter * (n - 1) / 2 - other), 0.0, n * self.top_speed)
        lower, upper = self.radius + way + drift + 1e-5
        return Window(-lower, upper)

    def in_reach(self, body: Motion, hazard: Motion) -> Array:
        """Returns whether it is in the window."""
        return self.window(body, hazard).contains(self.features(body, hazard)[:2])

    def sample(self, key: Array, model: Drone) -> tuple[Motion, Motion]:
        """Draws any velocities, and a place in the window."""
        place, speeds = jax.random.split(key)
        own, other = jax.random.uniform(speeds, (2, 2), float, -1.0, 1.0)
        body, hazard = (Motion(jnp.zeros(2), v) for v in (TOP_SPEED * own, self.top_speed * other))
        return body, hazard.replace(position=self.window(body, hazard).sample(place))


class State(struct.PyTreeNode):
    """The drone, and by kind all obstacles."""

    body: Motion
    obstacles: dict[str, Motion]  # leading axis (n,)
    time: Array  # () int32


class Params(struct.PyTreeNode):
    """Build by `make_params`."""

    body: Drone
    sources: dict[str, Obstacle]
    time_limit: Array  # () int32, steps
    discs: int = struct.field(pytree_node=False)


def make_params(discs: int = 10, *, time_limit: int = 100) -> Params:
    """Returns parameters with so many discs; raises ValueError if a number is out of range."""
    number("discs", discs, least=SEEN, most=100, integer=True)
    number("time_limit", time_limit, least=1, most=10**9, integer=True)
    table = ACCELERATION * jnp.asarray([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)], float)
    wall = Obstacle(0.1, axes=(0, 1))
    sources = {"disc": Obstacle(0.12, 0.02, 0.002), "pylon": Obstacle(0.1), "wall": wall}
    return Params(Drone(table, Brake()), sources, jnp.asarray(time_limit, jnp.int32), discs)


def reset(key: Array, params: Params) -> State:
    """Returns the drone at rest at the near end, and discs at least 0.9 away from it."""
    top = params.sources["disc"].top_speed
    low, high = jnp.asarray([[1.2, 0.0, -top, -top]]), jnp.asarray([[*FIELD, top, top]])
    drawn = jnp.split(jax.random.uniform(key, (params.discs, 4), float, low, high), 2, axis=1)
    still = lambda *places: Motion(jnp.asarray(places), jnp.zeros((len(places), 2)))  # noqa: E731
    obstacles = {"disc": Motion(*drawn), "pylon": still(*PYLONS), "wall": still((0.0, 0.0))}
    return State(Motion(jnp.asarray(START), jnp.zeros(2)), obstacles, jnp.asarray(0, jnp.int32))


def step(key: Array, state: State, action: Array, params: Params) -> tuple[State, Outcome]:
    """Moves all: 10 for each length nearer to the goal, 5 at it, -.05 a step; a hit ends it."""
    body, disc = params.body.step(state.body, params.body.control(action)), params.sources["disc"]
    noise = disc.draw(key, (params.discs,))
    moved = jax.vmap(disc.step, (0, None, 0))(state.obstacles["disc"], state.body, noise)
    out = moved.position - jnp.clip(moved.position, 0.0, jnp.asarray([FIELD]))
    discs = moved.replace(velocity=moved.velocity * jnp.where(out * moved.velocity > 0, -1, 1))
    new = State(body, {**state.obstacles, "disc": discs}, state.time + 1)
    hit = hits(sub_rmdps(params), body, hazards(new, params))
    crashed = jnp.any(jnp.stack(list(hit.values())))
    left, before = (jnp.linalg.norm(jnp.asarray(GOAL) - b.position) for b in (body, state.body))
    goal = (left < NEAR) & ~crashed
    reward = 10.0 * (before - left) - 0.05 + jnp.where(goal, 5.0, 0.0)
    ends = ended(crashed | goal, new.time, params.time_limit)
    return new, Outcome(reward, crashed.astype(reward.dtype), *ends, goal)


def observe(state: State, params: Params) -> Array:
    """Returns (26,): the way to the goal, and the `features` of the nearest discs."""
    seen = jax.vmap(params.sources["disc"].features, (None, 0))(state.body, state.obstacles["disc"])
    nearest = jnp.argsort(jnp.linalg.norm(seen[:, :2], axis=-1))[:SEEN]
    return jnp.concatenate([jnp.asarray(GOAL) - state.body.position, seen[nearest].ravel()])


def hazards(state: State, params: Params) -> dict[str, Hazards]:
    """Returns, by kind, all obstacles."""
    return {k: Hazards(m, jnp.ones(len(m.position), bool)) for k, m in state.obstacles.items()}


def sub_rmdps(params: Params) -> dict[str, SubRMDP]:
    """Returns, by kind, the drone with one obstacle."""
    return {kind: SubRMDP(params.body, source) for kind, source in params.sources.items()}
