"""Where a hazard can be met within some steps: boxes in the body's frame."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax.dynamics import ControlDistribution, Plans, VehicleModel, angle_of

MARGIN = 1e-5  # room units by which windows are widened, against rounding errors


class Window(struct.PyTreeNode):
    """A box in the body's frame."""

    lower: Array  # (2,) least x (ahead) and y (to the left), room units
    upper: Array  # (2,) greatest x and y, room units

    def contains(self, relative: Array) -> Array:
        """Returns whether positions are inside; nan counts as inside, so that it is noticed later.

        Args:
            relative: (..., 2) positions in the body's frame.

        Returns:
            (...) bool.
        """
        x, y = relative[..., 0], relative[..., 1]
        outside = (x < self.lower[0]) | (x > self.upper[0])
        return ~(outside | (y < self.lower[1]) | (y > self.upper[1]))

    @property
    def farthest(self) -> float:
        """The distance of the box's farthest corner from the body, room units."""
        return float(np.hypot(*np.maximum(np.abs(np.asarray(self.lower)), np.asarray(self.upper))))

    def sample(self, key: Array) -> Array:
        """Draws a position uniformly from the box, (2,) in the body's frame.

        Args:
            key: random key.
        """
        return jax.random.uniform(key, (2,), self.lower.dtype, self.lower, self.upper)

    def padded(self, pad: Array) -> "Window":
        """Returns the box made wider on every side.

        Args:
            pad: () room units.
        """
        return Window(self.lower - pad, self.upper + pad)


class Reach(struct.PyTreeNode):
    """Where a vehicle can get to within some moves, depending on the speed it begins with."""

    limits: Array  # (2,) least and greatest speed, room units / step
    change: Array  # (H,) greatest change of speed before each move, room units / step
    swing: Array  # (H, 2) (cos, sin) of the largest turn before each move; sin is 1 from 90 degrees

    @classmethod
    def create(cls, model: VehicleModel, horizon: int) -> "Reach":
        """Returns the reach of all sequences of actions and baseline controls.

        A baseline policy that is neither a `ControlDistribution` nor `Plans` must not turn or
        accelerate more than the actions do.

        Args:
            model: the vehicle's model.
            horizon: number of steps.
        """
        base = model.baseline
        turns = [np.asarray(angle_of(model.actions.rotation))]
        stronger = [np.asarray(model.actions.acceleration)]
        if isinstance(base, ControlDistribution | Plans):
            turns.append(np.asarray(angle_of(base.rotations)))
            stronger.append(np.asarray(base.max_acceleration))
        moves = np.arange(horizon) + (not model.delayed)
        swing = np.minimum(moves * max(np.abs(turn).max() for turn in turns), np.pi)
        change = moves * max(np.abs(part).max() for part in stronger)
        if model.room is not None:  # sliding along a wall, it moves sideways at any heading
            swing, change = np.full(horizon, np.pi), np.full(horizon, np.inf)
        sides = np.where(swing < np.pi / 2, np.sin(swing), 1.0)
        dtype = jax.dtypes.canonicalize_dtype(float)
        return cls(
            limits=jnp.asarray(model.speeds)[jnp.asarray([0, -1])],
            change=jax.device_put(np.asarray(change, dtype)),  # as is: infinite in a room
            swing=jnp.asarray(np.stack([np.cos(swing), sides], axis=-1), float),
        )

    def box(self, speed: Array) -> Window:
        """Returns the box that holds every position of the vehicle, the present one included.

        Args:
            speed: () speed that it begins with, room units / step.

        Returns:
            A box in the vehicle's frame.
        """
        low, high = jnp.minimum(self.limits[0], speed), jnp.maximum(self.limits[1], speed)
        slow = jnp.maximum(low, speed - self.change)
        fast = jnp.minimum(high, speed + self.change)
        back = self.swing[:, 0]
        ahead = jnp.sum(jnp.maximum(jnp.maximum(fast, slow * back), 0.0))
        behind = jnp.sum(jnp.minimum(jnp.minimum(slow, fast * back), 0.0))
        side = jnp.sum(jnp.maximum(jnp.abs(slow), jnp.abs(fast)) * self.swing[:, 1])
        return Window(jnp.stack([behind, -side]), jnp.stack([ahead, side]))


def padded_window(model: VehicleModel, horizon: int, pad: float) -> Window:
    """Returns the box that holds every position a vehicle can reach at any speed, made wider.

    Args:
        model: the vehicle's model.
        horizon: number of steps.
        pad: room units added on every side.

    Returns:
        A box in the vehicle's frame.
    """
    reach = Reach.create(model, horizon)
    return union(*map(reach.box, reach.limits)).padded(jnp.asarray(pad))


def union(one: Window, other: Window) -> Window:
    """Returns the smallest box that holds two others.

    Args:
        one: a box.
        other: another box.
    """
    return Window(jnp.minimum(one.lower, other.lower), jnp.maximum(one.upper, other.upper))


def sample_speed(key: Array, speeds: Array) -> Array:
    """Draws a speed: half the time a reachable one, half the time any between the limits.

    Args:
        key: random key.
        speeds: (S,) reachable speeds, ascending, room units / step.

    Returns:
        () room units / step.
    """
    pick, grid, smooth = jax.random.split(key, 3)
    discrete = jax.random.choice(grid, speeds)
    continuous = jax.random.uniform(smooth, (), speeds.dtype, speeds[0], speeds[-1])
    return jnp.where(jax.random.bernoulli(pick), discrete, continuous)
