"""Tracks as data: a centre line and two walls, with a builder for new ones."""

from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from scipy.spatial import cKDTree

from rp_jax.envs import sensing
from rp_jax.envs.walls import least_radius
from rp_jax.validate import number, positive, shown

SPACING = 0.02  # distance between points along straights, room units
ALONG = 0.055  # greatest distance between points along curves, room units
CELL = 0.2  # width of the look-up cells, room units
VIEW = 1.0  # range of the LIDAR, room units
LONGEST = 10_000  # greatest number of points of a centre line
WIDEST = 5.0  # greatest half-width, room units
LARGEST = 50.0  # side of the square that a track has to fit into, room units


@dataclass(frozen=True, eq=False)
class TrackPlan:
    """The plan of a track: a centre line drawn from (0, 0) along +x, one piece after another.

    Each method returns a new plan and leaves the old one unchanged. It raises ValueError if the
    piece cannot be drawn. For example:

    >>> TrackPlan().straight(2.0).curve(1.0, 180).straight(2.0).curve(1.0, 180)
    """

    half_width: float = 0.3  # distance of each wall from the centre line, room units
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))  # (n, 2) room units
    angles: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (n,) headings, radians
    position: tuple[float, float] = (0.0, 0.0)  # where the next piece begins, room units
    angle: float = 0.0  # heading at `position`, radians

    def _values(self) -> tuple:
        """Returns what makes two plans equal; adding 0 turns -0 into 0."""
        arrays = [(len(a), (np.asarray(a) + 0.0).tobytes()) for a in (self.points, self.angles)]
        return (self.half_width, *arrays, self.position, self.angle)

    def __eq__(self, other: object) -> bool:
        """Returns whether two plans draw the same track, number for number."""
        return isinstance(other, TrackPlan) and self._values() == other._values()

    def __hash__(self) -> int:
        """Returns the same number for equal plans."""
        return hash(self._values())

    def _extend(self, points, angles, position, angle) -> "TrackPlan":
        return replace(
            self,
            points=np.concatenate([self.points, points]),
            angles=np.concatenate([self.angles, angles]),
            position=(float(position[0]), float(position[1])),
            angle=float(angle),
        )

    def straight(self, length: float) -> "TrackPlan":
        """Returns the plan with a straight appended.

        Args:
            length: room units, greater than 0; rounded up to a multiple of `SPACING`.

        Raises:
            ValueError: the length is out of range.
        """
        positive("straight: length", length, most=SPACING * LONGEST)
        count = int(np.ceil(length / SPACING - 1e-6))
        way = np.arange(count + 1)[:, None] * SPACING
        points = np.asarray(self.position) + way * [np.cos(self.angle), np.sin(self.angle)]
        return self._extend(points[:-1], np.full(count, self.angle), points[-1], self.angle)

    def curve(self, radius: float, degrees: float) -> "TrackPlan":
        """Returns the plan with part of a circle appended.

        It has a point for each degree, or several where these would be farther apart than `ALONG`.

        Args:
            radius: radius of the centre line, room units, greater than 0.
            degrees: whole number of degrees to turn by, not 0; to the left is positive.

        Raises:
            ValueError: a value is out of range.
        """
        positive("curve: radius", radius, most=LARGEST)
        number("curve: degrees", degrees, least=-LONGEST, most=LONGEST)
        if degrees == 0 or degrees != round(degrees):
            raise ValueError(f"curve: degrees is {degrees}; it must be a whole number, not 0")
        side = np.sign(degrees)
        each = int(np.ceil(np.radians(1) * radius / ALONG))
        turn = np.radians(np.arange(abs(int(degrees)) * each + 1) / each) * side
        angles = self.angle + turn
        outward = np.stack([np.sin(angles), -np.cos(angles)], axis=-1) * side
        centre = np.asarray(self.position) - radius * outward[0]
        points = centre + radius * outward
        return self._extend(points[:-1], angles[:-1], points[-1], angles[-1])

    def close(self, radius: float = 0.3) -> "TrackPlan":
        """Returns the plan with a way back to the start: a straight, one turn, a straight along +x.

        Args:
            radius: radius of the turn, room units, greater than 0.

        Raises:
            ValueError: one turn does not lead back from here.
        """
        positive("close: radius", radius, most=LARGEST)
        left = (-np.degrees(self.angle) + 180) % 360 - 180
        turn = round(left)
        if abs(left - turn) > 1e-6:
            raise ValueError(f"close: {left} degrees are left to turn; they must be whole")
        if turn == -180 and self.position[1] > 0:
            turn = 180  # from above, the way back is to the left
        sine = np.sin(self.angle)
        # The turn ends on the line y = 0 if it starts at this height.
        height = radius * abs(1 - np.cos(self.angle)) * np.sign(self.position[1])
        ahead = 0.0 if abs(sine) < 1e-9 else (height - self.position[1]) / sine
        if ahead < 0 or self.position[0] >= 0:
            raise ValueError(
                f"close: from {self.position} heading {np.degrees(self.angle):.0f} degrees one "
                "turn does not lead home; aim at the line y = 0 left of the start"
            )
        plan = self.straight(ahead) if ahead > 1e-9 else self
        plan = plan.curve(radius, turn) if turn else plan
        if plan.position[0] >= 0:
            raise ValueError(f"close: the turn ends at x = {plan.position[0]:.3f}; it must be < 0")
        plan = plan.straight(-plan.position[0])
        # The last straight keeps its end point, as in the released code, unless that point is the
        # start itself.
        if np.hypot(*plan.position) < 1e-9:
            return plan
        end = np.asarray([plan.position])
        return plan._extend(end, np.asarray([plan.angle]), plan.position, plan.angle)

    def widened(self, half_width: float) -> "TrackPlan":
        """Returns the plan with the same centre line and another half-width.

        Args:
            half_width: distance of each wall from the centre line, room units.
        """
        return replace(self, half_width=half_width)


def default_plan() -> TrackPlan:
    """Returns the plan of the paper's circuit (figure 6, top), with 1,253 points."""
    plan = TrackPlan().straight(2.0).curve(0.3, 45).straight(1.0).curve(1.0, 225)
    plan = plan.curve(0.5, -145).straight(1.5).curve(1.2, 75).straight(0.5).curve(0.3, 110)
    return plan.straight(0.5).curve(0.3, -90).straight(0.5).curve(0.5, 120).close()


def narrowed_plan() -> TrackPlan:
    """Returns the default circuit with half-width 0.25 (table 2, "narrowed")."""
    return default_plan().widened(0.25)


def circle_plan() -> TrackPlan:
    """Returns the plan of a circle of radius 3 (table 2, "circular"; figure 6, bottom)."""
    return TrackPlan().curve(3.0, 360)


PLANS = {"default": default_plan, "narrowed": narrowed_plan, "circle": circle_plan}


class Track(struct.PyTreeNode):
    """A closed track with its look-up tables; to be built by `make_track`."""

    centre: Array  # (n, 2) points of the centre line, in driving order, room units
    direction: Array  # (n, 2) unit tangents
    onward: Array  # (n, 2) unit vectors from each centre point to the next
    walls: Array  # (w, 2) distinct wall points, room units
    nearest_centre: sensing.PointGrid  # finds the nearest centre point
    walls_in_view: sensing.PointGrid  # finds wall points within VIEW
    walls_in_contact: sensing.PointGrid  # finds wall points within the vehicle's radius
    walls_in_reach: sensing.PointGrid  # finds wall points that may have a threat


def make_track(plan: TrackPlan, radius: float, max_speed: float, reach: float) -> Track:
    """Checks a plan and returns the track with its look-up tables.

    Args:
        plan: a closed centre line.
        radius: radius of the vehicle, room units; a wall nearer than this is a crash.
        max_speed: length of the vehicle's longest step, room units.
        reach: greatest distance at which a wall point can have a threat, room units.

    Raises:
        ValueError: the track is too narrow, not closed, or crosses itself; or a step could lead
            between two points of a wall.
    """
    _check_plan(plan, radius)
    centre, angles = plan.points, plan.angles
    direction = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    left = np.stack([-direction[:, 1], direction[:, 0]], axis=-1) * plan.half_width
    sides = np.stack([centre + left, centre - left], axis=1)  # (n, 2, 2)
    _check_walls(sides, radius, max_speed)
    walls = sides.reshape(-1, 2)
    # Coinciding points (the hub of a tight turn) are a single event: counting it once keeps the
    # bound of Theorem 3, and makes it tighter.
    _, first = np.unique(walls.round(9), axis=0, return_index=True)
    walls = walls[np.sort(first)]
    room = cKDTree(walls).query(centre)[0]
    if room.min() <= radius:
        i = int(room.argmin())
        raise ValueError(
            f"track: at centre point {i} {centre[i].round(2)} a wall is {room[i]:.3f} away; it "
            f"must be farther than the vehicle's radius, {radius} (is a curve too tight?)"
        )
    onward = _steps(centre)
    return Track(
        centre=jnp.asarray(centre, float),
        onward=jnp.asarray(onward / np.linalg.norm(onward, axis=-1, keepdims=True), float),
        direction=jnp.asarray(direction, float),
        walls=jnp.asarray(walls, float),
        nearest_centre=sensing.nearest_of(centre, plan.half_width + CELL, CELL / 2),
        walls_in_view=sensing.points_within(walls, VIEW, CELL),
        walls_in_contact=sensing.points_within(walls, radius, CELL / 2),
        walls_in_reach=sensing.points_within(walls, reach, CELL),
    )


def _steps(points: np.ndarray) -> np.ndarray:
    """Returns the vectors from each point (n, ...) of a closed line to the next."""
    return np.roll(points, -1, axis=0) - points


def _check_walls(sides: np.ndarray, radius: float, max_speed: float) -> None:
    """Raises ValueError if a vehicle could slip between two points of a wall.

    Args:
        sides: (n, 2, 2) points of both walls, in order.
        radius: radius of the vehicle, room units.
        max_speed: length of the vehicle's longest step, room units.
    """
    gaps = np.linalg.norm(_steps(sides), axis=-1).max(axis=1)
    i, least = int(gaps.argmax()), least_radius(float(gaps.max()), max_speed)
    if radius <= least:
        raise ValueError(
            f"track: at centre point {i} points of a wall are {gaps[i]:.3f} apart; for steps of "
            f"{max_speed:g} the vehicle's radius, {radius:g}, must exceed {least:.4f}"
        )


def _check_shape(plan: TrackPlan) -> None:
    """Raises ValueError if look-up tables cannot be made of a plan, or would be far too large."""
    if not isinstance(plan, TrackPlan):
        raise ValueError(f"track is {shown(plan)}; it must be a TrackPlan")
    for name, tail in {"points": (2,), "angles": ()}.items():
        values = getattr(plan, name)
        good = isinstance(values, np.ndarray) and values.dtype.kind == "f" and values.ndim > 0
        if not good or values.shape[1:] != tail or not np.isfinite(values).all():
            shape = "(n, 2)" if tail else "(n,)"
            raise ValueError(
                f"track: {name} is {shown(values)}; it must be finite floats of shape {shape}"
            )
    number("track: centre points", len(plan.points), least=8, most=LONGEST, integer=True)
    if len(plan.angles) != len(plan.points):
        raise ValueError(
            f"track: angles is {shown(plan.angles)}; it must be one for each of the "
            f"{len(plan.points)} points"
        )
    width, height = np.ptp(plan.points, axis=0)
    number("track: width", float(width), most=LARGEST)
    number("track: height", float(height), most=LARGEST)
    step = np.linalg.norm(_steps(plan.points), axis=-1)
    if step.min() < 1e-9:
        i = int(step.argmin())
        raise ValueError(
            f"track: centre points {i} and {(i + 1) % len(step)} are one; neighbours must differ "
            "(the last is the first one's neighbour)"
        )
    if not isinstance(plan.position, tuple) or len(plan.position) != 2:
        raise ValueError(f"track: position is {plan.position!r}; it must be two numbers")
    for place in plan.position:
        number("track: position", place)
    number("track: angle", plan.angle)


def _check_plan(plan: TrackPlan, radius: float) -> None:
    """Raises ValueError if a plan is not closed, crosses itself, or is too narrow."""
    _check_shape(plan)
    number("track: half_width", plan.half_width, most=WIDEST)
    centre, width = plan.points, plan.half_width
    if width <= radius:
        raise ValueError(
            f"track: half_width is {width}; it must exceed the vehicle's radius, {radius}"
        )
    gap = np.linalg.norm(np.asarray(plan.position) - centre[0])
    turn = np.angle(np.exp(1j * (plan.angle - plan.angles[0])))
    if gap > 3 * SPACING or abs(turn) > np.radians(2):
        raise ValueError(
            f"track: the end misses the start by {gap:.3f} units and {np.degrees(turn):.0f} "
            "degrees; a track must be closed (see TrackPlan.close)"
        )
    # Two points that are far apart along the track but near in space mean that it overlaps. On a
    # curve of radius >= half_width, points that near are at most half a turn of it apart.
    step = np.linalg.norm(_steps(centre), axis=-1)
    along = np.concatenate([[0.0], np.cumsum(step)[:-1]])
    total = step.sum()
    for i in range(0, len(centre), 4):
        distance = np.linalg.norm(centre - centre[i], axis=-1)
        way = np.abs(along - along[i])
        way = np.minimum(way, total - way)
        clash = (way > np.pi * width) & (distance < 2 * width - 1e-6)
        if clash.any():
            j = int(np.argmax(clash))
            raise ValueError(
                f"track: it crosses itself: centre points {i} {centre[i].round(2)} and {j} "
                f"{centre[j].round(2)} are {distance[j]:.2f} apart; at least {2 * width:.2f} "
                "(two half-widths) are needed"
            )
