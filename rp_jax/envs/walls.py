"""Limits for vehicles and rollouts where walls are made of points."""

import math

FARTHEST = 30  # greatest horizon of a wall's threat, in steps: the look-up tables grow with it


def least_radius(gap: float, max_speed: float) -> float:
    """Returns the radius that a vehicle must exceed so that it cannot slip between wall points.

    Hits are looked for only at the ends of steps. A step of length `max_speed` through the middle
    of a gap begins and ends half that length from the wall, and the vehicle has to touch the wall
    there.

    Args:
        gap: greatest distance between neighbouring wall points, room units.
        max_speed: length of the vehicle's longest step, room units.
    """
    return math.hypot(gap, max_speed) / 2
