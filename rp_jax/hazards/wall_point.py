"""Walls, represented by fixed points."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax.dynamics import Vehicle, VehicleModel, make_vehicle, squared_distance, to_body_frame
from rp_jax.hazards.reach import MARGIN, Reach, Window, sample_speed, union


class WallPoint(struct.PyTreeNode):
    """A fixed point that must not come nearer to the body than `radius`.

    The hazard's state is its position (2,).
    """

    radius: Array  # () distance below which the point is hit, room units
    reach: Reach  # where the body can get to
    horizon: int = struct.field(pytree_node=False, default=5)  # steps of a rollout
    static: bool = struct.field(pytree_node=False, default=True)  # whether hazards never move

    @classmethod
    def create(cls, model: VehicleModel, radius: float = 0.1, horizon: int = 5) -> "WallPoint":
        """Returns the source with the window that a body can reach in `horizon` steps.

        Args:
            model: the body's model.
            radius: distance below which the point is hit, room units.
            horizon: steps after which a rollout of the threat is cut.
        """
        reach = Reach.create(model, horizon)
        return cls(radius=jnp.asarray(radius, float), reach=reach, horizon=horizon)

    def window_at(self, speed: Array) -> Window:
        """Returns where a point may be hit, as a box in the body's frame.

        Args:
            speed: () speed of the body, room units / step.
        """
        return self.reach.box(speed).padded(self.radius + MARGIN)

    @property
    def window(self) -> Window:
        """The box in the body's frame in which a point may be hit at any speed."""
        return union(*map(self.window_at, self.reach.limits))

    def in_reach(self, body: Vehicle, hazard: Array) -> Array:
        """Returns whether the point may be hit within `horizon` steps, () bool.

        Args:
            body: the body's state.
            hazard: (2,) position of the point.
        """
        relative = to_body_frame(hazard - body.position, body.heading)
        return self.window_at(body.speed).contains(relative)

    def draw(self, key: Array, shape: tuple[int, ...] = ()) -> Array:
        """Returns zeros, since nothing about a wall is random.

        Args:
            key: random key, not used.
            shape: shape of the result.
        """
        return jnp.zeros(shape)

    def step(self, hazard: Array, body: Vehicle, noise: Array) -> Array:
        """Returns the point's position unchanged.

        Args:
            hazard: (2,) position of the point.
            body: the body's state, not used.
            noise: not used.
        """
        return hazard

    def hits(self, body: Vehicle, hazard: Array) -> Array:
        """Returns whether the point is nearer to the body than `radius`, () bool.

        Args:
            body: the body's state.
            hazard: (2,) position of the point.
        """
        return squared_distance(hazard, body.position) < jnp.square(self.radius)

    def features(self, body: Vehicle, hazard: Array) -> Array:
        """Returns the features of a body and a point, in the body's frame.

        Args:
            body: the body's state.
            hazard: (2,) position of the point.

        Returns:
            (3,) the point's position (2), the body's speed.
        """
        relative = to_body_frame(hazard - body.position, body.heading)
        return jnp.concatenate([relative, body.speed[None]])

    def mirrored(self, features: Array) -> Array:
        """Returns the features of the left-right mirrored situation.

        Args:
            features: (..., 3).
        """
        signs = jnp.asarray([1.0, -1.0, 1.0], features.dtype)
        return features * jnp.broadcast_to(signs, features.shape)

    def sample(self, key: Array, model: VehicleModel) -> tuple[Vehicle, Array]:
        """Draws a body at the origin, and a point that it may hit, over all speeds.

        Args:
            key: random key.
            model: the body's model.

        Returns:
            The body's state and the point's position (2,).
        """
        where, fast = jax.random.split(key)
        vehicle = make_vehicle(jnp.zeros(2), 0.0, sample_speed(fast, model.speeds))
        return vehicle, self.window_at(vehicle.speed).sample(where)

    def grid(
        self, model: VehicleModel, nodes: int
    ) -> tuple[np.ndarray, np.ndarray, tuple[int, int, int]]:
        """Returns a grid over the window, reachable speeds and those half-way, for threats.

        Args:
            model: the body's model.
            nodes: about how many.

        Returns:
            The first node (3,), the steps between nodes (3,), and the numbers of nodes.
        """
        speeds = np.asarray(model.speeds, float)
        gap = float(np.min(np.diff(speeds))) / 2 if len(speeds) > 1 else 1.0
        fast = round((speeds[-1] - speeds[0]) / gap) + 1
        lower, upper = (np.asarray(edge, float) for edge in (self.window.lower, self.window.upper))
        each = math.sqrt(np.prod(upper - lower) * fast / nodes)
        ahead, aside = (math.ceil(side / each) + 1 for side in upper - lower)
        # The middle row of nodes lies straight ahead, so that mirror images are at nodes too.
        low = [lower[0], -each * (aside - 1) / 2, speeds[0]]
        return np.asarray(low), np.asarray([each, each, gap]), (ahead, aside, fast)

    def state_of(self, features: Array) -> tuple[Vehicle, Array]:
        """Returns a body, at the origin, and a point that have given features.

        Args:
            features: (3,).

        Returns:
            The body's state and the point's position (2,).
        """
        return make_vehicle(jnp.zeros(2), 0.0, features[2]), features[:2]
