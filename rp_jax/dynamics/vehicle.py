"""Dynamics of vehicles, shared by the agent's vehicle, moving obstacles, rollouts and adapters."""

import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax.dynamics.geometry import rotate


class Control(struct.PyTreeNode):
    """A command, or a table of commands along leading axes."""

    acceleration: Array  # (...) room units / step^2; without inertia, the step forward
    rotation: Array  # (..., 2) (cos, sin) of the turn; turns to the left are positive


class Vehicle(struct.PyTreeNode):
    """A vehicle's pose and speed, unbatched or along leading axes."""

    position: Array  # (..., 2) room units
    heading: Array  # (..., 2) unit vector (cos, sin)
    speed: Array  # (...) room units / step; negative in reverse


def make_vehicle(position, heading, speed) -> Vehicle:
    """Returns a vehicle's state, with its heading given as an angle.

    Args:
        position: (..., 2) room units.
        heading: (...) radians.
        speed: (...) room units / step.
    """
    angle = jnp.asarray(heading, float)
    return Vehicle(
        position=jnp.asarray(position, float),
        heading=jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1),
        speed=jnp.asarray(speed, float),
    )


def advance(vehicle: Vehicle, control: Control, speeds: Array, delayed: bool = True) -> Vehicle:
    """Moves a vehicle along its old heading at its old speed, then changes speed and heading.

    Args:
        vehicle: the state before, unbatched or with leading axes that broadcast.
        control: the command.
        speeds: (S,) ascending; the new speed is clipped to the first and the last.
        delayed: False for a point without inertia, which changes first, then moves at the new
            speed along the new heading, and is at rest again.

    Returns:
        The state after the step.
    """
    changed = Vehicle(
        position=vehicle.position,
        heading=rotate(vehicle.heading, control.rotation),
        speed=jnp.clip(vehicle.speed + control.acceleration, speeds[0], speeds[-1]),
    )
    moving = vehicle if delayed else changed
    return Vehicle(
        position=vehicle.position + moving.heading * moving.speed[..., None],
        heading=changed.heading,
        speed=changed.speed if delayed else jnp.zeros_like(changed.speed),
    )
