"""How a vehicle perceives fixed points: look-up of near points, distances, and LIDAR."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from scipy.spatial import cKDTree

from rp_jax.dynamics import squared_distance, to_body_frame

FAR = 1e4  # coordinate of padding points, out of every range


class PointGrid(struct.PyTreeNode):
    """Fixed points, sorted into the cells of a grid from which they can matter.

    Each cell lists every point that can be within a radius of some position in the cell
    (`points_within`) or that can be the nearest one to it (`nearest_of`), so that a look-up is a
    single gather.
    """

    origin: Array  # (2,) corner of the grid, room units
    cell: Array  # () width of a cell, room units
    points: Array  # (nx, ny, C, 2) candidates of each cell, padded by FAR
    index: Array  # (nx, ny, C) int32, their indices in the original list; padding has -1

    def _cell_of(self, position: Array) -> tuple[Array, Array]:
        cell = jnp.floor((position - self.origin) / self.cell).astype(jnp.int32)
        nx, ny = self.points.shape[:2]
        return jnp.clip(cell[0], 0, nx - 1), jnp.clip(cell[1], 0, ny - 1)

    def near(self, position: Array) -> Array:
        """Returns the candidates around a position; callers still have to test their distance.

        Args:
            position: (2,) room units.

        Returns:
            (C, 2) positions.
        """
        return self.points[self._cell_of(position)]

    def nearest(self, position: Array) -> Array:
        """Returns the index of the point nearest to a position, () int; the first of equals.

        Args:
            position: (2,) room units.
        """
        i, j = self._cell_of(position)
        squared = squared_distance(self.points[i, j], position[None])
        # Two minima instead of an argmin, since they vectorise; padding has index -1.
        last = jnp.iinfo(self.index.dtype).max
        row = jnp.where(self.index[i, j] < 0, last, self.index[i, j])
        return jnp.min(jnp.where(squared > jnp.min(squared), last, row))


def _cells(points: np.ndarray, cell: float, margin: float):
    origin = points.min(axis=0) - margin
    shape = np.maximum(np.ceil((points.max(axis=0) + margin - origin) / cell).astype(int), 1)
    ij = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    return origin, shape, origin + (ij.reshape(-1, 2) + 0.5) * cell


def _pack(points, cell, origin, shape, members) -> PointGrid:
    width = max(1, max(len(m) for m in members))
    table = np.full((len(members), width, 2), FAR)
    index = np.full((len(members), width), -1, np.int32)
    for row, member in enumerate(members):
        index[row, : len(member)] = np.sort(member)
        table[row, : len(member)] = points[index[row, : len(member)]]
    return PointGrid(
        origin=jnp.asarray(origin, float),
        cell=jnp.asarray(cell, float),
        points=jnp.asarray(table.reshape(*shape, width, 2), float),
        index=jnp.asarray(index.reshape(*shape, width)),
    )


def points_within(points: np.ndarray, radius: float, cell: float) -> PointGrid:
    """Returns a grid that finds all points within a radius, from anywhere in the plane.

    Args:
        points: (P, 2) room units.
        radius: room units.
        cell: width of a cell, room units.
    """
    points = np.asarray(points, float)
    origin, shape, centres = _cells(points, cell, radius)
    reach = radius + cell * np.sqrt(0.5) + 1e-6
    return _pack(points, cell, origin, shape, cKDTree(points).query_ball_point(centres, reach))


def nearest_of(points: np.ndarray, margin: float, cell: float) -> PointGrid:
    """Returns a grid that finds the nearest of some points.

    It is exact up to a distance of `margin` from the points. Beyond that it finds the point nearest
    to the centre of the position's cell.

    Args:
        points: (P, 2) room units.
        margin: room units.
        cell: width of a cell, room units.
    """
    points = np.asarray(points, float)
    origin, shape, centres = _cells(points, cell, margin + cell)
    tree = cKDTree(points)
    diagonal = cell * np.sqrt(2)
    distance, nearest = tree.query(centres)
    # Distances from the cell's centre and from a position in it differ by at most half a diagonal.
    members = tree.query_ball_point(centres, distance + diagonal + 1e-6)
    exact = distance <= margin + diagonal / 2
    lists = [m if ok else [n] for m, ok, n in zip(members, exact, nearest, strict=True)]
    return _pack(points, cell, origin, shape, lists)


class DistanceField(struct.PyTreeNode):
    """The distance to the nearest of some fixed points, from a table: a single gather.

    Between the corners of a cell the distance is interpolated. Since the distance to a point is
    convex, that exceeds it by at most cell^2 / (8 distance), which is subtracted: the result is a
    lower bound.
    """

    origin: Array  # (2,) corner of the table, room units
    cell: Array  # () width of a cell, room units
    corners: Array  # (nx, ny, 4) distances from a cell's corners: (0, 0), (0, 1), (1, 0), (1, 1)
    excess: Array  # () greatest error of the interpolation, at distances from `near` on

    def __call__(self, position: Array) -> Array:
        """Returns a lower bound of the distance to the nearest point, () room units.

        Args:
            position: (2,) room units; the bound holds at distances from `near` on
                (`distance_field`).
        """
        # Plain numbers and one flat index: vectors and two indices take twice as long.
        (nx, ny, _), scale = self.corners.shape, 1 / self.cell
        x = jnp.clip(position[0] * scale - self.origin[0] * scale, 0.0, nx - 1e-3)
        y = jnp.clip(position[1] * scale - self.origin[1] * scale, 0.0, ny - 1e-3)
        i, j = x.astype(jnp.int32), y.astype(jnp.int32)
        u, v = x - i.astype(x.dtype), y - j.astype(y.dtype)
        c = self.corners.reshape(-1, 4).at[i * ny + j].get(mode="clip")  # nan is no index
        near, far = c[0] + v * (c[1] - c[0]), c[2] + v * (c[3] - c[2])
        return near + u * (far - near) - self.excess


def distance_field(
    points: np.ndarray, near: float, margin: float = 0.5, cell: float = 0.01
) -> DistanceField:
    """Returns a table of distances to the nearest of some points.

    Args:
        points: (P, 2) room units.
        near: distance from which on the table's results are lower bounds, room units.
        margin: width of the table around the points, room units; beyond it, the distances are those
            at its edge.
        cell: width of a cell, room units.
    """
    points = np.asarray(points, float)
    origin, shape, _ = _cells(points, cell, margin)
    ij = np.stack(np.meshgrid(*[np.arange(n + 1) for n in shape], indexing="ij"), axis=-1)
    distance, _ = cKDTree(points).query(origin + ij * cell)
    corners = [distance[:-1, :-1], distance[:-1, 1:], distance[1:, :-1], distance[1:, 1:]]
    return DistanceField(
        origin=jnp.asarray(origin, float),
        cell=jnp.asarray(cell, float),
        corners=jnp.asarray(np.stack(corners, axis=-1), float),
        # Inside a cell the distance may be smaller than at its corners by about its diagonal.
        excess=jnp.asarray(cell**2 / (8 * (near - 1.5 * cell)) + 1e-6, float),
    )


def edge_direction(number: Array, bins: int) -> tuple[Array, Array]:
    """Returns the directions of the edges of equal angular bins, from 0 at -pi to `bins` at pi.

    They are exact along the axes, so that a point straight ahead or behind lies on an edge. They
    are computed by series, since neither a look-up in a table nor the library's functions are
    vectorised.

    Args:
        number: (...) int, numbers of edges.
        bins: number of bins.

    Returns:
        (cos, sin), each (...).
    """
    dtype = jax.dtypes.canonicalize_dtype(float)
    fourfold = 4 * number.astype(dtype)
    quarters = jnp.round(fourfold * (1 / bins))
    rest = (fourfold - bins * quarters) * (jnp.pi / 2 / bins)  # exact, times pi / 4 at most
    square = rest * rest
    cos, sin = jnp.zeros_like(rest), jnp.zeros_like(rest)
    for n in range(7 if dtype == jnp.float64 else 4, -1, -1):  # Taylor series, exact up to rounding
        sign = (-1) ** n
        cos = cos * square + sign / math.factorial(2 * n)
        sin = sin * square + sign / math.factorial(2 * n + 1)
    sin = sin * rest
    turns = quarters.astype(jnp.int32)
    odd, ahead = turns & 1 == 1, turns & 2 == 2
    x, y = jnp.where(odd, sin, -cos), jnp.where(odd, -cos, -sin)
    return jnp.where(ahead, -x, x), jnp.where(ahead, -y, y)


def _approximate_angle(x: Array, y: Array) -> Array:
    """Returns arctan2(y, x) by a polynomial, to 2e-6 rad; much faster than the library's."""
    ax, ay = jnp.abs(x), jnp.abs(y)
    z = jnp.minimum(ax, ay) / jnp.maximum(jnp.maximum(ax, ay), 1e-30)
    s = z * z
    p = -0.33262347 + s * (0.19354346 + s * (-0.11643287 + s * (0.05265332 - s * 0.01172120)))
    p = z * (0.99997726 + s * p)
    p = jnp.where(ay > ax, jnp.pi / 2 - p, p)
    p = jnp.where(x < 0, jnp.pi - p, p)
    return jnp.where(y < 0, -p, p)


def lidar(points: Array, position: Array, heading: Array, bins: int, view: float = 1.0) -> Array:
    """Returns the distance of the nearest point in each angular bin around the heading.

    Args:
        points: (P, 2) in the world's frame, room units.
        position: (2,) of the sensor, room units.
        heading: (2,) unit vector.
        bins: number of equal bins, counted from straight behind over the right side to straight
            behind again. They are open: a point on an edge is not seen.
        view: range of the sensor, room units; points at this distance or farther are not seen.

    Returns:
        (bins,) distances, 0 where nothing is seen.
    """
    local = to_body_frame(points - position[None], heading)
    x, y = local[:, 0], local[:, 1]
    # The approximate angle gives the nearest edge, and the exact vectors the side of it.
    turn = (_approximate_angle(x, y) + jnp.pi) * (bins / (2 * jnp.pi))
    nearest = jnp.clip(jnp.round(turn).astype(jnp.int32), 0, bins)
    cos, sin = edge_direction(nearest, bins)
    cross = cos * y - sin * x
    k = jnp.where(cross > 0, nearest, nearest - 1)
    k = jnp.where(k < 0, bins - 1, jnp.where(k < bins, k, 0))
    squared = x * x + y * y
    seen = (squared < view * view) & (cross != 0)
    # Points that are not seen go to a spare bin. Floats that are not negative have the same order
    # as their bits, and minima of integers are faster.
    integer = jnp.dtype(f"int{8 * squared.dtype.itemsize}")
    bits = jax.lax.bitcast_convert_type(squared, integer)
    none = np.asarray(np.finfo(squared.dtype).max).view(integer)  # not infinity: JAX_DEBUG_INFS
    best = jnp.full(bins + 1, none)
    best = best.at[jnp.where(seen, k, bins)].min(bits, mode="promise_in_bounds")[:bins]
    distance = jnp.sqrt(jax.lax.bitcast_convert_type(best, squared.dtype))
    return jnp.where(best == none, 0.0, distance)
