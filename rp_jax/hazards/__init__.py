"""Sources of danger: their contract, where they can be met, and the built-in kinds."""

from rp_jax.hazards.bomb import Bomb
from rp_jax.hazards.moving_obstacle import MovingObstacle
from rp_jax.hazards.reach import Reach, Window, padded_window, sample_speed
from rp_jax.hazards.source import HazardSource, SubRMDP, is_static
from rp_jax.hazards.wall_point import WallPoint

__all__ = [
    "Bomb",
    "HazardSource",
    "MovingObstacle",
    "Reach",
    "SubRMDP",
    "WallPoint",
    "Window",
    "is_static",
    "padded_window",
    "sample_speed",
]
