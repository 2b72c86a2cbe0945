"""Sources of danger (events E_n), and the sub-R-MDP of one agent and one hazard (Assumption 1)."""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax.kinematics import (
    AgentModel,
    ControlDistribution,
    Vehicle,
    advance,
    angle_of,
    make_vehicle,
    rotate,
    squared_distance,
    to_ego,
)


class Agent(Protocol):
    """Whoever acts: `kinematics.AgentModel`, or a body of any simulator.

    States and controls are pytrees of its own; the methods are unbatched.
    """

    actions: Any  # table of controls, leading axis (A,)
    baseline: Any  # eta^(o): a ControlDistribution over such controls, or Plans

    @property
    def num_threats(self) -> int:
        """Threats of a state: A of them under one baseline policy."""

    @property
    def delayed(self) -> bool:
        """Whether a control moves the agent one step later only."""

    def control(self, action: Array) -> Any:
        """The command of an action."""

    def step(self, agent: Any, control: Any) -> Any:
        """The agent's next state, p(s_o' | s_o, a)."""

    def mirrored_threats(self) -> np.ndarray:
        """(num_threats,) index of each action's left-right mirror image.

        Where there is no such symmetry, `np.arange(num_threats)`; then `HazardSource.mirrored`
        must return its argument.
        """


class HazardSource(Protocol):
    """One kind of event: how its hazards move, when they strike, how a model sees them.

    All methods are unbatched. Hazard n never depends on the other hazards (Assumption 1).
    """

    @property
    def window(self) -> "Window":
        """Holds every hazard that is `in_reach` at some speed, in the agent's frame."""

    @property
    def horizon(self) -> int:
        """Steps after which a rollout of the sub-R-MDP is cut."""

    @property
    def static(self) -> bool:
        """Whether hazards stay where they are, so that threats can be enumerated."""

    def draw(self, key: Array, shape: tuple[int, ...] = ()) -> Any:
        """The random numbers of one step (or of an array of steps)."""

    def step(self, hazard: Any, agent: Any, noise: Any) -> Any:
        """The hazard's next state, p(s_n' | s_n, s_o, a)."""

    def hits(self, agent: Any, hazard: Any) -> Array:
        """() bool, the event's indicator d_n."""

    def in_reach(self, agent: Any, hazard: Any) -> Array:
        """() bool, it may be hit within `horizon` steps; elsewhere the threat is 0."""

    def features(self, agent: Any, hazard: Any) -> Array:
        """(F,) what the threat model sees: the agent's frame, relative position first."""

    def mirrored(self, features: Array) -> Array:
        """`features` (..., F) of the left-right mirrored situation."""

    def sample(self, key: Array, agent: Any) -> tuple[Any, Any]:
        """An (agent, hazard) pair drawn over what is `in_reach`, every speed included."""

    def state_of(self, features: Array) -> tuple[Any, Any]:
        """An (agent, hazard) pair that has these features (F,); inverts `features`."""


class Window(struct.PyTreeNode):
    """A box in the agent's frame."""

    lower: Array  # (2,) room units
    upper: Array  # (2,)

    def contains(self, relative: Array) -> Array:
        """(...) bool for relative positions (..., 2). Nan counts as inside: it must be noticed."""
        x, y = relative[..., 0], relative[..., 1]
        outside = (x < self.lower[0]) | (x > self.upper[0])
        return ~(outside | (y < self.lower[1]) | (y > self.upper[1]))

    @property
    def farthest(self) -> float:
        """Distance of its farthest corner from the agent."""
        return float(np.hypot(*np.maximum(np.abs(np.asarray(self.lower)), np.asarray(self.upper))))

    def sample(self, key: Array) -> Array:
        """(2,) a relative position, uniform over the box."""
        return jax.random.uniform(key, (2,), self.lower.dtype, self.lower, self.upper)

    def padded(self, pad: Array) -> "Window":
        """Wider by `pad` () on every side."""
        return Window(self.lower - pad, self.upper + pad)


class SubRMDP(struct.PyTreeNode):
    """The R-MDP of a single hazard: Algorithm 2, line 2, estimates its threat function."""

    agent: Any  # an Agent
    source: Any  # a HazardSource
    beta: Array | float = 0.999  # discount of danger


class Reach(struct.PyTreeNode):
    """Where a vehicle can get within some moves, by the speed it begins with."""

    limits: Array  # (2,) slowest and fastest, room units / step
    change: Array  # (H,) greatest change of speed before each move
    swing: Array  # (H, 2) (cos, sin) of the largest turn before each move; sin counts to 90 degrees

    @classmethod
    def create(cls, agent: AgentModel, horizon: int) -> "Reach":
        """Covers every sequence of actions and baseline controls for `horizon` steps."""
        base = agent.baseline
        turns = [np.asarray(angle_of(table)) for table in (agent.actions.rotation, base.rotations)]
        stronger = [np.asarray(agent.actions.acceleration), np.asarray(base.strongest)]
        moves = np.arange(horizon) + (not agent.delayed)
        swing = np.minimum(moves * max(np.abs(turn).max() for turn in turns), np.pi)
        change = moves * max(np.abs(part).max() for part in stronger)
        if agent.room is not None:  # who slides along a wall goes aside at any heading
            swing, change = np.full(horizon, np.pi), np.full(horizon, np.inf)
        sides = np.where(swing < np.pi / 2, np.sin(swing), 1.0)
        return cls(
            limits=jnp.asarray(agent.speeds)[jnp.asarray([0, -1])],
            change=jnp.asarray(change, float),
            swing=jnp.asarray(np.stack([np.cos(swing), sides], axis=-1), float),
        )

    def box(self, speed: Array) -> Window:
        """What it may come by, in its own frame; its place now is inside. `speed` is ()."""
        low, high = jnp.minimum(self.limits[0], speed), jnp.maximum(self.limits[1], speed)
        slow = jnp.maximum(low, speed - self.change)
        fast = jnp.minimum(high, speed + self.change)
        back = self.swing[:, 0]
        ahead = jnp.sum(jnp.maximum(jnp.maximum(fast, slow * back), 0.0))
        behind = jnp.sum(jnp.minimum(jnp.minimum(slow, fast * back), 0.0))
        side = jnp.sum(jnp.maximum(jnp.abs(slow), jnp.abs(fast)) * self.swing[:, 1])
        return Window(jnp.stack([behind, -side]), jnp.stack([ahead, side]))


MARGIN = 1e-5  # room units by which windows are too wide, for rounding


def padded_window(agent: AgentModel, horizon: int, pad: float) -> Window:
    """What `agent` may come by in `horizon` steps at any speed, and `pad` room units around it."""
    reach = Reach.create(agent, horizon)
    return _union(*map(reach.box, reach.limits)).padded(jnp.asarray(pad))


def sample_speed(key: Array, speeds: Array) -> Array:
    """Half the time one of the reachable speeds, half the time any between the limits."""
    pick, grid, smooth = jax.random.split(key, 3)
    discrete = jax.random.choice(grid, speeds)
    continuous = jax.random.uniform(smooth, (), speeds.dtype, speeds[0], speeds[-1])
    return jnp.where(jax.random.bernoulli(pick), discrete, continuous)


def _union(one: Window, other: Window) -> Window:
    return Window(jnp.minimum(one.lower, other.lower), jnp.maximum(one.upper, other.upper))


class WallPoint(struct.PyTreeNode):
    """A fixed point that must not come nearer than `radius`. The hazard is its position (2,)."""

    radius: Array  # () room units
    reach: Reach  # of the agent
    horizon: int = struct.field(pytree_node=False, default=5)
    static: bool = struct.field(pytree_node=False, default=True)

    @classmethod
    def create(cls, agent: AgentModel, radius: float = 0.1, horizon: int = 5) -> "WallPoint":
        """With what `agent` can reach in `horizon` steps."""
        reach = Reach.create(agent, horizon)
        return cls(radius=jnp.asarray(radius, float), reach=reach, horizon=horizon)

    def window_at(self, speed: Array) -> Window:
        """Where a point may be hit, in the frame of an agent that begins with `speed` ()."""
        return self.reach.box(speed).padded(self.radius + MARGIN)

    @property
    def window(self) -> Window:
        """See `HazardSource`."""
        return _union(*map(self.window_at, self.reach.limits))

    def in_reach(self, agent: Vehicle, hazard: Array) -> Array:
        """See `HazardSource`."""
        relative = to_ego(hazard - agent.position, agent.heading)
        return self.window_at(agent.speed).contains(relative)

    def draw(self, key: Array, shape: tuple[int, ...] = ()) -> Array:
        """Nothing is random; zeros keep the signature."""
        return jnp.zeros(shape)

    def step(self, hazard: Array, agent: Vehicle, noise: Array) -> Array:
        """A wall stays where it is."""
        return hazard

    def hits(self, agent: Vehicle, hazard: Array) -> Array:
        """Nearer than `radius`."""
        return squared_distance(hazard, agent.position) < jnp.square(self.radius)

    def features(self, agent: Vehicle, hazard: Array) -> Array:
        """(3,) position in the agent's frame (2), the agent's speed."""
        relative = to_ego(hazard - agent.position, agent.heading)
        return jnp.concatenate([relative, agent.speed[None]])

    def mirrored(self, features: Array) -> Array:
        """See `HazardSource`."""
        signs = jnp.asarray([1.0, -1.0, 1.0], features.dtype)
        return features * jnp.broadcast_to(signs, features.shape)

    def sample(self, key: Array, agent: AgentModel) -> tuple[Vehicle, Array]:
        """See `HazardSource`."""
        where, fast = jax.random.split(key)
        vehicle = make_vehicle(jnp.zeros(2), 0.0, sample_speed(fast, agent.speeds))
        return vehicle, self.window_at(vehicle.speed).sample(where)

    def state_of(self, features: Array) -> tuple[Vehicle, Array]:
        """See `HazardSource`."""
        return make_vehicle(jnp.zeros(2), 0.0, features[2]), features[:2]


class Bomb(WallPoint):
    """A fixed point that goes off when the agent's centre of mass comes nearer than `radius`.

    The agent is held by the walls of a square room about the origin, so its way depends on where
    in the room it is.
    """

    ahead: Array | float = 0.0  # () from the agent's position to its centre of mass, room units

    @classmethod
    def create(
        cls, agent: AgentModel, radius: float = 1.0, horizon: int = 15, ahead: float = 0.0
    ) -> "Bomb":
        """With what `agent` can reach in `horizon` steps."""
        return cls(
            radius=jnp.asarray(radius, float),
            reach=Reach.create(agent, horizon),
            horizon=horizon,
            ahead=jnp.asarray(ahead, float),
        )

    def window_at(self, speed: Array) -> Window:
        """See `WallPoint`."""
        return super().window_at(speed).padded(jnp.asarray(self.ahead))

    def centre(self, agent: Vehicle) -> Array:
        """(2,) the agent's centre of mass."""
        return agent.position + self.ahead * agent.heading

    def hits(self, agent: Vehicle, hazard: Array) -> Array:
        """Nearer than `radius` to the centre of mass."""
        return squared_distance(hazard, self.centre(agent)) < jnp.square(self.radius)

    def features(self, agent: Vehicle, hazard: Array) -> Array:
        """(6,) in the agent's frame: its position (2), the room's centre (2); 4 x heading.

        The room looks alike from its four sides, so four times the heading (cos, sin) says all.
        """
        relative = to_ego(hazard - agent.position, agent.heading)
        centre = to_ego(-agent.position, agent.heading)
        twice = rotate(agent.heading, agent.heading)
        return jnp.concatenate([relative, centre, rotate(twice, twice)])

    def mirrored(self, features: Array) -> Array:
        """See `HazardSource`."""
        signs = jnp.asarray([1.0, -1.0] * 3, features.dtype)
        return features * jnp.broadcast_to(signs, features.shape)

    def sample(self, key: Array, agent: AgentModel) -> tuple[Vehicle, Array]:
        """See `HazardSource`. The agent may be anywhere in the room, as may the bomb in reach."""
        assert agent.room is not None
        place, turn, where = jax.random.split(key, 3)
        room = jnp.full(2, agent.room)
        position = jax.random.uniform(place, (2,), room.dtype, -room, room)
        angle = jax.random.uniform(turn, (), float, -jnp.pi, jnp.pi)
        far = jnp.max(jnp.maximum(-self.window.lower, self.window.upper))
        low, high = jnp.maximum(-room, position - far), jnp.minimum(room, position + far)
        hazard = jax.random.uniform(where, (2,), room.dtype, low, high)
        return make_vehicle(position, angle, 0.0), hazard

    def state_of(self, features: Array) -> tuple[Vehicle, Array]:
        """See `HazardSource`. Of the four headings that look alike, the one nearest to 0."""
        angle = angle_of(features[4:]) / 4
        heading = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        agent = make_vehicle(-rotate(features[2:4], heading), angle, 0.0)
        return agent, agent.position + rotate(features[:2], heading)


class MovingObstacle(struct.PyTreeNode):
    """A vehicle that drives at random; centres nearer than `distance` collide."""

    distance: Array  # () room units, sum of the two radii
    speeds: Array  # (S,) its reachable speeds, ascending
    behaviour: ControlDistribution  # what it does at each step
    reach: Reach  # of the agent
    drift: Array  # (H,) greatest gain of an obstacle's speed before each of its moves
    horizon: int = struct.field(pytree_node=False, default=8)
    static: bool = struct.field(pytree_node=False, default=False)

    @classmethod
    def create(
        cls,
        agent: AgentModel,
        speeds: Array,
        behaviour: ControlDistribution,
        distance: float = 0.2,
        horizon: int = 8,
    ) -> "MovingObstacle":
        """With what it and `agent` can reach in `horizon` steps."""
        return cls(
            distance=jnp.asarray(distance, float),
            speeds=jnp.asarray(speeds, float),
            behaviour=behaviour,
            reach=Reach.create(agent, horizon),
            drift=jnp.arange(horizon) * behaviour.strongest,
            horizon=horizon,
        )

    def window_at(self, speed: Array, other: Array) -> Window:
        """Where they may meet: by the agent's speed and the `other`'s, whatever its heading."""
        other = jnp.abs(other)
        limit = jnp.maximum(jnp.max(jnp.abs(self.speeds)), other)
        fast = jnp.minimum(limit, other + self.drift)
        return self.reach.box(speed).padded(self.distance + jnp.sum(fast) + MARGIN)

    @property
    def window(self) -> Window:
        """See `HazardSource`."""
        ends = [self.window_at(speed, self.speeds[-1]) for speed in self.reach.limits]
        return _union(*ends)

    def in_reach(self, agent: Vehicle, hazard: Vehicle) -> Array:
        """See `HazardSource`."""
        relative = to_ego(hazard.position - agent.position, agent.heading)
        return self.window_at(agent.speed, hazard.speed).contains(relative)

    def draw(self, key: Array, shape: tuple[int, ...] = ()):
        """The obstacle's controls, of the given shape."""
        return self.behaviour.sample(key, shape)

    def step(self, hazard: Vehicle, agent: Vehicle, noise) -> Vehicle:
        """It drives on, regardless of the agent."""
        return advance(hazard, noise, self.speeds)

    def hits(self, agent: Vehicle, hazard: Vehicle) -> Array:
        """Centres nearer than `distance`."""
        return squared_distance(hazard.position, agent.position) < jnp.square(self.distance)

    def features(self, agent: Vehicle, hazard: Vehicle) -> Array:
        """(6,) in the agent's frame: position (2), heading (cos, sin), its speed, the agent's."""
        relative = to_ego(hazard.position - agent.position, agent.heading)
        heading = to_ego(hazard.heading, agent.heading)
        speeds = jnp.stack([hazard.speed, agent.speed])
        return jnp.concatenate([relative, heading, speeds])

    def mirrored(self, features: Array) -> Array:
        """See `HazardSource`."""
        signs = jnp.asarray([1.0, -1.0, 1.0, -1.0, 1.0, 1.0], features.dtype)
        return features * jnp.broadcast_to(signs, features.shape)

    def sample(self, key: Array, agent: AgentModel) -> tuple[Vehicle, Vehicle]:
        """See `HazardSource`."""
        where, turn, own, other = jax.random.split(key, 4)
        angle = jax.random.uniform(turn, (), float, -jnp.pi, jnp.pi)
        speed, faster = sample_speed(own, agent.speeds), sample_speed(other, self.speeds)
        position = self.window_at(speed, faster).sample(where)
        return make_vehicle(jnp.zeros(2), 0.0, speed), make_vehicle(position, angle, faster)

    def state_of(self, features: Array) -> tuple[Vehicle, Vehicle]:
        """See `HazardSource`."""
        heading = features[2:4] / jnp.sqrt(squared_distance(features[2:4], jnp.zeros(2)))
        hazard = Vehicle(position=features[:2], heading=heading, speed=features[4])
        return make_vehicle(jnp.zeros(2), 0.0, features[5]), hazard
