"""The percept of a policy: observation, threats and admissible actions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array


class Encoded(NamedTuple):
    """An observation as it is stored: the LIDAR in bytes, the rest unchanged."""

    scan: Array  # (..., L) uint8, distances of 0 to 255; 255 where nothing is seen
    rest: Array  # (..., R) float, all values beside the LIDAR


class Percept(NamedTuple):
    """All that a policy may know about a batch of states."""

    encoded: Encoded  # (B,) observations
    admissible: Array  # (B, A) bool, the admissible actions
    secure: Array  # (B,) bool, some action's threat is at most the threshold
    threat: Array  # (B, A) threats of the actions
    threshold: Array  # (B,) largest admissible threat
    summed: Array | None = None  # (B, A) threats before any look ahead; None where it is not known


def encode(observation: Array, scan: int, pool: int) -> Encoded:
    """Splits an observation into its LIDAR, pooled and in bytes, and the rest.

    Bytes cannot hold nan: where the LIDAR has a value that is not finite, the rest becomes nan.

    Args:
        observation: (n,) whose first `scan` values are distances in [0, 1], 0 where nothing is
            seen.
        scan: number of LIDAR values.
        pool: number of neighbouring bins of which only the least distance is kept.
    """
    distance = jnp.where(observation[:scan] == 0, 1.0, observation[:scan])
    nearest = jnp.min(distance.reshape(scan // pool, pool), axis=-1)
    sound = jnp.all(jnp.isfinite(observation[:scan]))
    rest = jnp.where(sound, observation[scan:], jnp.nan)
    return Encoded(jnp.round(nearest * 255).astype(jnp.uint8), rest)


def non_finite(encoded: Encoded, threat: Array) -> tuple[Array, Array]:
    """Returns for which states the observation, or a threat, is nan or infinite.

    Args:
        encoded: observations, leading axis (B,); integers are always finite.
        threat: (B, A) threats of the actions.

    Returns:
        (bad observation, bad threat), (B,) bool each.
    """
    seen = [leaf for leaf in jax.tree.leaves(encoded) if leaf.dtype.kind == "f"]
    bad = [not_finite(leaf.reshape(len(leaf), -1)) for leaf in seen]
    return jnp.any(jnp.stack(bad), axis=0), not_finite(threat)


def not_finite(values: Array) -> Array:
    """Returns which rows hold a value that is nan or infinite.

    Args:
        values: (B, n).

    Returns:
        (B,) bool.
    """
    return ~jnp.all(jnp.isfinite(values), axis=-1)
