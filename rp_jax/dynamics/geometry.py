"""Rotations, frames and distances in the plane."""

import jax.numpy as jnp
from jax import Array


def rotate(vector: Array, rotation: Array) -> Array:
    """Turns vectors by angles.

    Args:
        vector: (..., 2) x and y.
        rotation: (..., 2) cos and sin of the angle.

    Returns:
        (..., 2) x and y.
    """
    x, y = vector[..., 0], vector[..., 1]
    c, s = rotation[..., 0], rotation[..., 1]
    return jnp.stack([x * c - y * s, x * s + y * c], axis=-1)


def to_body_frame(vector: Array, heading: Array) -> Array:
    """Expresses vectors in the frame whose x axis is a given heading.

    Args:
        vector: (..., 2) x and y in the world's frame.
        heading: (..., 2) unit vector in the world's frame.

    Returns:
        (..., 2) x (ahead) and y (to the left).
    """
    x, y = vector[..., 0], vector[..., 1]
    c, s = heading[..., 0], heading[..., 1]
    return jnp.stack([x * c + y * s, y * c - x * s], axis=-1)


def squared_distance(a: Array, b: Array) -> Array:
    """Returns the squared distance of two positions.

    Args:
        a: (..., 2) a position.
        b: (..., 2) another position.

    Returns:
        (...), in the square of the positions' unit.
    """
    x, y = a[..., 0] - b[..., 0], a[..., 1] - b[..., 1]
    return x * x + y * y


def angle_of(vector: Array) -> Array:
    """Returns the angle of a vector in radians, in (-pi, pi].

    Args:
        vector: (..., 2) x and y.

    Returns:
        (...) counted from the x axis; to the left is positive.
    """
    return jnp.arctan2(vector[..., 1], vector[..., 0])
