"""Vehicles that drive at random, as obstacles."""

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax.dynamics import (
    ControlDistribution,
    Vehicle,
    VehicleModel,
    advance,
    make_vehicle,
    squared_distance,
    to_body_frame,
)
from rp_jax.hazards.reach import MARGIN, Reach, Window, sample_speed, union


class MovingObstacle(struct.PyTreeNode):
    """A vehicle that drives at random; two centres nearer than `distance` collide."""

    distance: Array  # () sum of the two radii, room units
    speeds: Array  # (S,) reachable speeds of an obstacle, ascending, room units / step
    behaviour: ControlDistribution  # the distribution of an obstacle's controls at each step
    reach: Reach  # where the body can get to
    drift: Array  # (H,) greatest gain of an obstacle's speed before each of its moves
    horizon: int = struct.field(pytree_node=False, default=8)  # steps of a rollout
    static: bool = struct.field(pytree_node=False, default=False)  # whether hazards never move

    @classmethod
    def create(
        cls,
        model: VehicleModel,
        speeds: Array,
        behaviour: ControlDistribution,
        distance: float = 0.2,
        horizon: int = 8,
    ) -> "MovingObstacle":
        """Returns the source with the window in which a body may meet an obstacle.

        Args:
            model: the body's model.
            speeds: (S,) reachable speeds of an obstacle, ascending, room units / step.
            behaviour: the distribution of an obstacle's controls at each step.
            distance: distance of the two centres below which they collide, room units.
            horizon: steps after which a rollout of the threat is cut.
        """
        return cls(
            distance=jnp.asarray(distance, float),
            speeds=jnp.asarray(speeds, float),
            behaviour=behaviour,
            reach=Reach.create(model, horizon),
            drift=jnp.arange(horizon, dtype=float) * behaviour.max_acceleration,
            horizon=horizon,
        )

    def window_at(self, speed: Array, other: Array) -> Window:
        """Returns where the two may meet at any heading, as a box in the body's frame.

        Args:
            speed: () speed of the body, room units / step.
            other: () speed of the obstacle, room units / step.
        """
        other = jnp.abs(other)
        limit = jnp.maximum(jnp.max(jnp.abs(self.speeds)), other)
        fast = jnp.minimum(limit, other + self.drift)
        return self.reach.box(speed).padded(self.distance + jnp.sum(fast) + MARGIN)

    @property
    def window(self) -> Window:
        """The box in the body's frame in which the two may meet at any speeds."""
        ends = [self.window_at(speed, self.speeds[-1]) for speed in self.reach.limits]
        return union(*ends)

    def in_reach(self, body: Vehicle, hazard: Vehicle) -> Array:
        """Returns whether the two may collide within `horizon` steps, () bool.

        Args:
            body: the state of the agent's vehicle.
            hazard: the obstacle's state.
        """
        relative = to_body_frame(hazard.position - body.position, body.heading)
        return self.window_at(body.speed, hazard.speed).contains(relative)

    def draw(self, key: Array, shape: tuple[int, ...] = ()):
        """Draws controls of the obstacle.

        Args:
            key: random key.
            shape: leading axes of the result.

        Returns:
            Controls with `shape` as leading axes.
        """
        return self.behaviour.draw(key, shape)

    def step(self, hazard: Vehicle, body: Vehicle, noise) -> Vehicle:
        """Returns the obstacle's next state, which does not depend on the body.

        Args:
            hazard: the obstacle's state.
            body: the state of the agent's vehicle, not used.
            noise: the obstacle's control, as `draw` returns it.
        """
        return advance(hazard, noise, self.speeds)

    def hits(self, body: Vehicle, hazard: Vehicle) -> Array:
        """Returns whether the two centres are nearer than `distance`, () bool.

        Args:
            body: the state of the agent's vehicle.
            hazard: the obstacle's state.
        """
        return squared_distance(hazard.position, body.position) < jnp.square(self.distance)

    def features(self, body: Vehicle, hazard: Vehicle) -> Array:
        """Returns the features of a body and an obstacle, in the body's frame.

        Args:
            body: the state of the agent's vehicle.
            hazard: the obstacle's state.

        Returns:
            (6,) the obstacle's position (2), its heading (cos, sin), its speed, the body's speed.
        """
        relative = to_body_frame(hazard.position - body.position, body.heading)
        heading = to_body_frame(hazard.heading, body.heading)
        speeds = jnp.stack([hazard.speed, body.speed])
        return jnp.concatenate([relative, heading, speeds])

    def mirrored(self, features: Array) -> Array:
        """Returns the features of the left-right mirrored situation.

        Args:
            features: (..., 6).
        """
        signs = jnp.asarray([1.0, -1.0, 1.0, -1.0, 1.0, 1.0], features.dtype)
        return features * jnp.broadcast_to(signs, features.shape)

    def sample(self, key: Array, model: VehicleModel) -> tuple[Vehicle, Vehicle]:
        """Draws a body at the origin, and an obstacle of any heading that it may meet.

        Args:
            key: random key.
            model: the body's model.

        Returns:
            The body's state and the obstacle's state.
        """
        where, turn, own, other = jax.random.split(key, 4)
        angle = jax.random.uniform(turn, (), float, -jnp.pi, jnp.pi)
        speed, faster = sample_speed(own, model.speeds), sample_speed(other, self.speeds)
        position = self.window_at(speed, faster).sample(where)
        return make_vehicle(jnp.zeros(2), 0.0, speed), make_vehicle(position, angle, faster)

    def state_of(self, features: Array) -> tuple[Vehicle, Vehicle]:
        """Returns a body, at the origin, and an obstacle that have given features.

        Args:
            features: (6,); the heading need not be of unit length.

        Returns:
            The body's state and the obstacle's state.
        """
        heading = features[2:4] / jnp.sqrt(squared_distance(features[2:4], jnp.zeros(2)))
        hazard = Vehicle(position=features[:2], heading=heading, speed=features[4])
        return make_vehicle(jnp.zeros(2), 0.0, features[5]), hazard
