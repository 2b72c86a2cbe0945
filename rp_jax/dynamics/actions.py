"""Tables of discrete actions, and their left-right mirror images."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from rp_jax.dynamics.vehicle import Control


def control_table(accelerations: Sequence[float], turns: Sequence[float]) -> Control:
    """Returns the table of all pairs of an acceleration and a turn.

    Args:
        accelerations: changes of speed, room units / step^2.
        turns: changes of heading, radians / step; turns to the left are positive.

    Returns:
        Controls with leading axis (len(accelerations) * len(turns),); the turn varies fastest.
    """
    acceleration = np.repeat(np.asarray(accelerations, float), len(turns))
    turn = np.tile(np.asarray(turns, float), len(accelerations))
    return Control(
        acceleration=jnp.asarray(acceleration, float),
        rotation=jnp.asarray(np.stack([np.cos(turn), np.sin(turn)], axis=-1), float),
    )


def mirrored_actions(actions: Control) -> np.ndarray:
    """Returns the index of each action's left-right mirror image.

    Args:
        actions: (A,) table of controls.

    Returns:
        (A,) int, the row with the same acceleration and the opposite turn.

    Raises:
        ValueError: the table does not hold the mirror image of every action.
    """
    acceleration, rotation = np.asarray(actions.acceleration), np.asarray(actions.rotation)
    table = np.concatenate([acceleration[:, None], rotation], axis=-1)
    return mirror_images(
        table, [1, 1, -1], "actions: the table holds no mirror image of some of its actions"
    )


def mirror_images(table: np.ndarray, signs: Sequence[int], missing: str) -> np.ndarray:
    """Returns the index of the row that each row of a table becomes under changes of sign.

    Args:
        table: (n, F) numbers.
        signs: (F,) factor 1 or -1 of each column.
        missing: message of the error.

    Returns:
        (n,) int.

    Raises:
        ValueError: the table does not hold what one of its rows becomes.
    """
    gap = np.abs(table[:, None] - table[None] * np.asarray(signs)).max(axis=-1)
    if (gap.min(axis=-1) > 1e-6).any():
        raise ValueError(missing)
    return gap.argmin(axis=-1)
