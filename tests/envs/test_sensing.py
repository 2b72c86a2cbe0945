import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rp_jax.envs.sensing import FAR, edge_direction, lidar, nearest_of, points_within

scan = jax.jit(lidar, static_argnums=3)
seeds = st.integers(0, 2**32 - 1)


def brute_force(points, position, angle, bins, view):
    """Distances by arctan2 in double precision, and the angle between each point and an edge."""
    x, y = (points - position).T
    distance = np.hypot(x, y)
    turn = np.angle((x + 1j * y) * np.exp(-1j * angle)) + np.pi
    width = 2 * np.pi / bins
    aside = np.abs(turn - np.round(turn / width) * width)
    seen = distance < view
    found = np.full(bins, np.inf)
    np.minimum.at(found, np.floor(turn / width).astype(int)[seen] % bins, distance[seen])
    return np.where(np.isinf(found), 0, found), distance, aside


def heading_of(angle):
    return jnp.asarray([np.cos(angle), np.sin(angle)], float)


@given(
    hnp.arrays(np.float64, (40, 2), elements=st.floats(-1.5, 1.5)),
    hnp.arrays(np.float64, 2, elements=st.floats(-0.5, 0.5)),
    st.floats(-np.pi, np.pi),
    st.sampled_from([360, 45, 8]),
    st.sampled_from([1.0, 0.6]),
)
def test_lidar_finds_the_nearest_point_of_each_bin(points, position, angle, bins, view):
    expected, distance, aside = brute_force(points, position, angle, bins, view)
    clear = (aside > 1e-9) & (distance > 1e-9) & (np.abs(distance - view) > 1e-9)
    # Points that rounding might move to another bin are taken away from both.
    points = np.where(clear[:, None], points, FAR)
    expected, _, _ = brute_force(points, position, angle, bins, view)
    with jax.enable_x64(True):
        found = scan(jnp.asarray(points), jnp.asarray(position), heading_of(angle), bins, view)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@given(seeds)
def test_lidar_in_single_precision_errs_only_within_rounding_of_an_edge(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.2, 1.2, (300, 2)).astype(np.float32)
    angle = rng.uniform(-np.pi, np.pi)
    _, distance, aside = brute_force(points, 0.0, angle, 360, 1.0)
    clear = (aside > 1e-6) & (distance > 1e-3) & (np.abs(distance - 1) > 1e-6)
    points[~clear] = FAR
    expected, _, _ = brute_force(points, 0.0, angle, 360, 1.0)
    found = scan(jnp.asarray(points), jnp.zeros(2), heading_of(angle), 360)
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("degrees", "seen_in"), [(0.5, 180), (-0.5, 179), (90.5, 270), (179.5, 359), (-179.5, 0)]
)
def test_bins_count_from_behind_over_the_right_and_the_front_to_the_left(degrees, seen_in):
    point = 0.5 * np.asarray([[np.cos(np.radians(degrees)), np.sin(np.radians(degrees))]])
    found = scan(jnp.asarray(point, float), jnp.zeros(2), heading_of(0.0), 360)
    np.testing.assert_allclose(found, 0.5 * (np.arange(360) == seen_in), atol=1e-6)


def test_bins_turn_with_the_heading_and_move_with_the_sensor():
    degrees = 37.5
    angle = np.radians(degrees + 20.5)
    point = np.asarray([[3.0 + 0.25 * np.cos(angle), -2.0 + 0.25 * np.sin(angle)]])
    position = jnp.asarray([3.0, -2.0])
    found = scan(jnp.asarray(point, float), position, heading_of(np.radians(37.5)), 360)
    np.testing.assert_allclose(found, 0.25 * (np.arange(360) == 200), atol=1e-6)


def test_bins_are_open_so_a_point_straight_ahead_is_not_seen():
    ahead = jnp.asarray([[0.5, 0.0], [0.25, 0.0]])
    assert not scan(ahead, jnp.zeros(2), heading_of(0.0), 360).any()


def test_every_direction_of_an_edge_falls_between_its_two_bins(x64):
    for k in range(360):
        for side, expected in ((1e-9, k), (-1e-9, (k - 1) % 360)):
            angle = np.radians(k - 180) + side
            point = jnp.asarray([[0.5 * np.cos(angle), 0.5 * np.sin(angle)]])
            found = scan(point, jnp.zeros(2), heading_of(0.0), 360)
            assert np.flatnonzero(found).tolist() == [expected]


@pytest.mark.parametrize(("distance", "seen"), [(0.999, True), (1.0, False), (1.001, False)])
def test_points_at_the_end_of_the_view_or_farther_are_not_seen(distance, seen):
    point = distance * jnp.asarray([[0.6, 0.8]])
    found = scan(point, jnp.zeros(2), jnp.asarray([1.0, 0.0]), 360)
    assert bool(found.any()) == seen


def test_neither_padding_nor_a_point_at_the_sensor_is_seen():
    points = jnp.asarray([[FAR, FAR], [0.0, 0.0]])
    found = scan(points, jnp.zeros(2), heading_of(0.3), 360)
    np.testing.assert_array_equal(found, np.zeros(360))


@pytest.mark.parametrize("bins", [360, 45, 12, 1])
def test_the_edges_divide_the_circle(precision, bins):
    number = np.arange(bins + 1)
    x, y = map(np.asarray, edge_direction(jnp.asarray(number), bins))
    assert x.dtype == precision
    angles = number * (2 * np.pi / bins) - np.pi
    atol = {"float64": 1e-15, "float32": 2e-7}[precision]
    np.testing.assert_allclose(x, np.cos(angles), rtol=0, atol=atol)
    np.testing.assert_allclose(y, np.sin(angles), rtol=0, atol=atol)
    axes = 4 * number % bins == 0
    assert axes.sum() >= 2
    np.testing.assert_array_equal(np.sort(np.abs([x, y])[:, axes], axis=0)[0], 0)  # exactly


def look_up(method, positions):
    return np.asarray(jax.jit(jax.vmap(method))(jnp.asarray(positions, float)), np.float64)


@settings(max_examples=12)  # every example has shapes of its own to compile
@given(seeds, st.floats(0.05, 1.5), st.floats(0.05, 1.0))
def test_a_grid_finds_every_point_within_its_radius_from_anywhere(seed, radius, cell):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (30, 2)).astype(np.float32).astype(float)
    positions = rng.uniform(-3, 3, (100, 2)).astype(np.float32).astype(float)
    found = look_up(points_within(points, radius, cell).near, positions)
    for position, candidates in zip(positions, found, strict=True):
        distance = np.linalg.norm(points - position, axis=-1)
        listed = {tuple(p) for p in candidates if p[0] < FAR}
        assert listed <= {tuple(p) for p in points}
        assert listed >= {tuple(p) for p in points[distance < radius]}


def test_a_grid_lists_a_point_once_and_pads_with_points_far_away():
    points = np.asarray([[0.0, 0.0], [0.1, 0.0], [2.0, 0.0]])
    grid = points_within(points, 0.3, 0.2)
    near = np.asarray(grid.near(jnp.asarray([0.05, 0.0])))
    np.testing.assert_allclose(near[:2], points[:2], atol=1e-7)
    far = np.asarray(grid.near(jnp.asarray([2.0, 0.1])))
    np.testing.assert_allclose(far, [[2.0, 0.0], [FAR, FAR]], atol=1e-7)


@settings(max_examples=12)
@given(seeds, st.floats(0.1, 1.0), st.floats(0.05, 0.5))
def test_the_nearest_point_is_exact_within_the_margin(seed, margin, cell):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (30, 2)).astype(np.float32).astype(float)
    positions = rng.uniform(-2, 2, (200, 2)).astype(np.float32).astype(float)
    index = look_up(nearest_of(points, margin, cell).nearest, positions).astype(int)
    distance = np.linalg.norm(points[None] - positions[:, None], axis=-1)
    least = distance.min(axis=1)
    chosen = distance[np.arange(len(positions)), index]
    assert (index >= 0).all()  # never the padding, however far off
    inside = least <= margin
    assert inside.any()
    assert (chosen - least)[inside].max() < 1e-6


def test_farther_than_the_margin_some_near_point_is_returned():
    points = np.asarray([[0.0, 0.0], [1.0, 0.0]])
    grid = nearest_of(points, 0.2, 0.1)
    assert grid.nearest(jnp.asarray([-50.0, 3.0])) == 0
    assert grid.nearest(jnp.asarray([50.0, -3.0])) == 1


def test_of_equally_near_points_the_first_is_returned():
    for points in ([[0.5, 0.0], [-0.5, 0.0]], [[-0.5, 0.0], [0.5, 0.0]]):
        assert nearest_of(np.asarray(points), 1.0, 0.2).nearest(jnp.zeros(2)) == 0


def test_points_on_the_axes_are_on_an_edge():
    points = jnp.asarray([[0.0, 0.5], [-0.5, 0.0], [0.0, -0.5]])
    assert not lidar(points, jnp.zeros(2), jnp.asarray([1.0, 0.0]), 360).any()
