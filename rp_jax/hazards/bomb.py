"""Bombs that lie in a room."""

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.dynamics import (
    Vehicle,
    VehicleModel,
    angle_of,
    make_vehicle,
    rotate,
    squared_distance,
    to_body_frame,
)
from rp_jax.hazards.reach import Reach, Window
from rp_jax.hazards.wall_point import WallPoint


class Bomb(WallPoint):
    """A fixed point that goes off when the body's centre of mass comes nearer than `radius`.

    The walls of a square room around the origin hold the body, so that its motion depends on where
    in the room it is. The hazard's state is its position (2,).
    """

    ahead: Array | float = 0.0  # () how far the centre of mass lies ahead of the body's position

    @classmethod
    def create(
        cls, model: VehicleModel, radius: float = 1.0, horizon: int = 15, ahead: float = 0.0
    ) -> "Bomb":
        """Returns the source with the window that a body can reach in `horizon` steps.

        Args:
            model: the body's model, with a room.
            radius: distance below which the bomb goes off, room units.
            horizon: steps after which a rollout of the threat is cut.
            ahead: how far the centre of mass lies ahead of the body's position, room units.
        """
        return cls(
            radius=jnp.asarray(radius, float),
            reach=Reach.create(model, horizon),
            horizon=horizon,
            ahead=jnp.asarray(ahead, float),
        )

    def window_at(self, speed: Array) -> Window:
        """Returns where a bomb may be hit, as a box in the body's frame.

        Args:
            speed: () speed of the body, room units / step.
        """
        return super().window_at(speed).padded(jnp.asarray(self.ahead))

    def centre(self, body: Vehicle) -> Array:
        """Returns the body's centre of mass, (2,) room units.

        Args:
            body: the body's state.
        """
        return body.position + self.ahead * body.heading

    def hits(self, body: Vehicle, hazard: Array) -> Array:
        """Returns whether the centre of mass is nearer to the bomb than `radius`, () bool.

        Args:
            body: the body's state.
            hazard: (2,) position of the bomb.
        """
        return squared_distance(hazard, self.centre(body)) < jnp.square(self.radius)

    def features(self, body: Vehicle, hazard: Array) -> Array:
        """Returns the features of a body and a bomb, all in the body's frame.

        The room looks the same from its four sides, so that four times the heading's angle
        suffices.

        Args:
            body: the body's state.
            hazard: (2,) position of the bomb.

        Returns:
            (6,) the bomb's position (2), the room's centre (2), (cos, sin) of 4 times the heading
            (2).
        """
        relative = to_body_frame(hazard - body.position, body.heading)
        centre = to_body_frame(-body.position, body.heading)
        twice = rotate(body.heading, body.heading)
        return jnp.concatenate([relative, centre, rotate(twice, twice)])

    def mirrored(self, features: Array) -> Array:
        """Returns the features of the left-right mirrored situation.

        Args:
            features: (..., 6).
        """
        signs = jnp.asarray([1.0, -1.0] * 3, features.dtype)
        return features * jnp.broadcast_to(signs, features.shape)

    def sample(self, key: Array, model: VehicleModel) -> tuple[Vehicle, Array]:
        """Draws a body anywhere in the room, and a bomb in the part of the room that it can reach.

        Args:
            key: random key.
            model: the body's model, with a room.

        Returns:
            The body's state, at rest, and the bomb's position (2,).
        """
        assert model.room is not None
        place, turn, where = jax.random.split(key, 3)
        room = jnp.full(2, model.room)
        position = jax.random.uniform(place, (2,), room.dtype, -room, room)
        angle = jax.random.uniform(turn, (), float, -jnp.pi, jnp.pi)
        far = jnp.max(jnp.maximum(-self.window.lower, self.window.upper))
        low, high = jnp.maximum(-room, position - far), jnp.minimum(room, position + far)
        hazard = jax.random.uniform(where, (2,), room.dtype, low, high)
        return make_vehicle(position, angle, 0.0), hazard

    def state_of(self, features: Array) -> tuple[Vehicle, Array]:
        """Returns a body and a bomb that have given features.

        Of the four headings with the same features it takes the one nearest to 0.

        Args:
            features: (6,).

        Returns:
            The body's state, at rest, and the bomb's position (2,).
        """
        angle = angle_of(features[4:]) / 4
        heading = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        body = make_vehicle(-rotate(features[2:4], heading), angle, 0.0)
        return body, body.position + rotate(features[:2], heading)
