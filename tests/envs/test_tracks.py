from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from rp_jax.envs import tracks
from rp_jax.envs.tracks import (
    PLANS,
    SPACING,
    VIEW,
    TrackPlan,
    circle_plan,
    default_plan,
    make_track,
    narrowed_plan,
)

RADIUS, FASTEST, REACH = 0.1, 0.1, 0.7


def oval(straight=2.0, radius=1.0, half_width=0.3, side=1):
    plan = TrackPlan(half_width=half_width)
    for _ in range(2):
        plan = plan.straight(straight).curve(radius, 180 * side)
    return plan


def rounded_square(radius):
    plan = TrackPlan().straight(1.0)
    for _ in range(3):
        plan = plan.curve(radius, 90).straight(2.0)
    return plan.curve(radius, 90).straight(1.0)


def made(plan):
    return jax.device_get(make_track(plan, RADIUS, FASTEST, REACH))


def nearest(points, others):
    return cKDTree(np.asarray(points, float)).query(np.asarray(others, float))[0]


def test_the_default_track_is_the_recorded_one(golden, x64):
    data = golden("traces_circuit")
    track = made(default_plan())
    assert track.centre.shape == (1253, 2)
    np.testing.assert_allclose(track.centre, data["cpos"], atol=1e-9)
    np.testing.assert_allclose(track.direction, data["front_arr"], atol=1e-9)
    # The same set of wall points, each of which is held once.
    assert nearest(track.walls, data["wall"]).max() < 1e-9
    assert nearest(data["wall"], track.walls).max() < 1e-9
    assert len(track.walls) == len(np.unique(data["wall"].round(9), axis=0)) < len(data["wall"])


def test_onward_points_from_each_centre_point_to_the_next(x64):
    track = made(default_plan())
    step = np.roll(track.centre, -1, axis=0) - track.centre
    length = np.linalg.norm(step, axis=-1, keepdims=True)
    np.testing.assert_allclose(track.onward * length, step, atol=1e-12)
    # All but the last, which the released track puts a little past the start.
    assert (np.sum(np.asarray(track.onward * track.direction)[:-1], axis=-1) > 0.99).all()


@pytest.mark.parametrize("name", PLANS)
def test_every_track_is_closed_and_free_of_walls_along_its_centre(name):
    plan = PLANS[name]()
    track = made(plan)
    step = np.linalg.norm(np.roll(track.centre, -1, axis=0) - track.centre, axis=-1)
    assert step.max() < 3 * SPACING
    np.testing.assert_allclose(np.linalg.norm(track.direction, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(track.onward, axis=-1), 1, atol=1e-6)
    assert nearest(track.walls, track.centre).min() > plan.half_width - SPACING / 2
    assert nearest(track.centre, track.walls).max() < plan.half_width + 1e-5


def test_the_narrowed_track_has_the_default_centre_line_and_nearer_walls():
    narrow, default = narrowed_plan(), default_plan()
    np.testing.assert_array_equal(narrow.points, default.points)
    assert narrow.half_width == 0.25
    away = nearest(default.points, made(narrow).walls)
    assert (np.abs(away - 0.25) < 0.01).all()


def test_the_circle_has_radius_3_and_is_driven_to_the_left():
    track = made(circle_plan())
    centre = np.asarray(track.centre) - [0.0, 3.0]
    assert len(centre) == 360
    np.testing.assert_allclose(np.linalg.norm(centre, axis=-1), 3.0, atol=1e-5)
    angle = np.unwrap(np.arctan2(centre[:, 1], centre[:, 0]))
    np.testing.assert_allclose(np.diff(angle), np.radians(1), atol=1e-5)
    walls = np.linalg.norm(np.asarray(track.walls) - [0.0, 3.0], axis=-1)
    np.testing.assert_allclose(np.sort(walls), [2.7] * 360 + [3.3] * 360, atol=1e-5)


def test_a_straight_puts_a_point_every_spacing_and_leaves_the_old_plan_alone():
    old = TrackPlan()
    plan = old.straight(0.1)
    np.testing.assert_allclose(plan.points[:, 0], np.arange(5) * SPACING)
    np.testing.assert_allclose(plan.points[:, 1], 0)
    np.testing.assert_allclose(plan.position, (0.1, 0.0))
    assert len(old.points) == 0
    np.testing.assert_allclose(old.straight(0.09).position, (0.1, 0.0))  # whole steps
    assert old.straight(0.3).straight(0.7).points.shape == (50, 2)


@pytest.mark.parametrize(("degrees", "end"), [(90, (1.0, 1.0)), (-90, (1.0, -1.0))])
def test_a_curve_turns_to_the_left_by_positive_degrees(degrees, end):
    plan = TrackPlan().curve(1.0, degrees)
    assert plan.points.shape == (90, 2)
    np.testing.assert_allclose(plan.position, end, atol=1e-12)
    np.testing.assert_allclose(plan.angle, np.radians(degrees))
    np.testing.assert_allclose(np.degrees(plan.angles), np.sign(degrees) * np.arange(90), atol=1e-9)


def test_close_leads_home_in_the_direction_of_the_start():
    plan = TrackPlan().straight(2.0).curve(1.0, -180).straight(3.0).close(radius=1.0)
    np.testing.assert_allclose(plan.position, (0.0, 0.0), atol=SPACING)
    np.testing.assert_allclose(np.exp(1j * plan.angle), 1.0, atol=1e-9)
    made(plan)


def test_the_tables_find_all_walls_in_view_in_contact_and_in_reach():
    track = make_track(default_plan(), RADIUS, FASTEST, REACH)
    walls = np.asarray(track.walls)
    rng = np.random.default_rng(0)
    where = np.asarray(track.centre)[rng.integers(1253, size=200)]
    where = where + rng.uniform(-0.4, 0.4, where.shape)
    where = where.astype(np.float32)
    distance = np.linalg.norm(walls[None] - where[:, None], axis=-1)
    for grid, radius in (
        (track.walls_in_view, VIEW),
        (track.walls_in_contact, RADIUS),
        (track.walls_in_reach, REACH),
    ):
        found = np.asarray(jax.jit(jax.vmap(grid.near))(jnp.asarray(where)))
        there = np.linalg.norm(found - where[:, None], axis=-1) < radius - 1e-5
        np.testing.assert_array_equal(there.sum(axis=1), (distance < radius - 1e-5).sum(axis=1))


def test_the_nearest_centre_point_is_found_all_over_the_track_and_beyond_its_walls():
    track = make_track(default_plan(), RADIUS, FASTEST, REACH)
    rng = np.random.default_rng(1)
    where = np.asarray(track.centre)[rng.integers(1253, size=500)]
    where = where + rng.uniform(-0.3, 0.3, where.shape)
    where = where.astype(np.float32)
    index = np.asarray(jax.jit(jax.vmap(track.nearest_centre.nearest))(jnp.asarray(where)))
    distance = np.linalg.norm(np.asarray(track.centre)[None] - where[:, None], axis=-1)
    np.testing.assert_allclose(distance[np.arange(500), index], distance.min(axis=1), atol=1e-6)


lengths = st.integers(25, 150).map(lambda steps: steps * SPACING)


@settings(max_examples=8)
@given(lengths, st.floats(0.35, 1.5), st.floats(0.15, 0.3), st.sampled_from([-1, 1]))
def test_closed_ovals_are_tracks_with_walls_on_both_sides(straight, radius, half_width, side):
    plan = oval(straight, radius, half_width, side)
    track = made(plan)
    assert len(track.centre) == 2 * round(straight / SPACING) + 360
    np.testing.assert_allclose(plan.position, (0.0, 0.0), atol=1e-9)
    assert (np.sum(track.onward * track.direction, axis=-1) > 0.999).all()
    np.testing.assert_allclose(nearest(track.walls, track.centre), half_width, atol=0.01)
    left = np.stack([-track.direction[:, 1], track.direction[:, 0]], axis=-1)
    for offset in (left, -left):
        assert nearest(track.walls, track.centre + half_width * offset).max() < 1e-5


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (
            lambda p: p.straight(-1.0),
            r"^straight: length is -1\.0; it must be .* above 0",
        ),
        (
            lambda p: p.straight(0.0),
            r"^straight: length is 0\.0; it must be .* above 0",
        ),
        (lambda p: p.straight(float("inf")), "^straight: length is inf; .* finite number"),
        (lambda p: p.straight(float("nan")), "^straight: length is nan"),
        (
            lambda p: p.curve(0.0, 90),
            r"^curve: radius is 0\.0; it must be .* above 0",
        ),
        (
            lambda p: p.curve(-0.5, 90),
            r"^curve: radius is -0\.5; it must be .* above 0",
        ),
        (lambda p: p.curve(float("nan"), 90), "^curve: radius is nan"),
        (lambda p: p.curve(1.0, 0), "^curve: degrees is 0; it must be a whole number, not 0"),
        (lambda p: p.curve(1.0, 1.5), r"^curve: degrees is 1\.5; it must be a whole number"),
        (lambda p: p.straight(2.0).close(), r"^close: from \(2\.0, 0\.0\) heading 0 degrees"),
        (
            lambda p: p.curve(1.0, 90).straight(1.0).close(),
            r"^close: from \(1\.0.*, 2\.0.*\) heading 90 degrees one turn does not lead home",
        ),
    ],
)
def test_a_piece_that_cannot_be_drawn_names_the_field_and_the_value(draw, message):
    with pytest.raises(ValueError, match=message):
        draw(TrackPlan())


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (oval(half_width=0.1), r"^track: half_width is 0\.1; it must exceed .* radius, 0\.1"),
        (oval(half_width=-1.0), r"^track: half_width is -1\.0"),
        (oval(half_width=float("nan")), "^track: half_width is nan"),
        (TrackPlan(), "^track: centre points is 0; it must be .* at least 8"),
        (
            TrackPlan().straight(0.1),
            "^track: centre points is 5; it must be .* at least 8",
        ),
        (
            TrackPlan().straight(2.0).curve(1.0, 180),
            r"^track: the end misses the start by 2\.828 units and .*180 degrees",
        ),
        (
            TrackPlan().straight(2.0).curve(1.0, 180).straight(3.0).curve(1.0, 180),
            r"^track: the end misses the start by 1\.000 units and -?0 degrees",
        ),
        (
            TrackPlan().curve(1.0, 360).curve(1.0, -360),
            r"^track: it crosses itself: centre points 0 \[0\. 0\.\] and \d+ .* least 0\.60",
        ),
        (
            oval(2.0, 0.25, 0.3),
            r"^track: it crosses itself: .* are 0\.5\d* apart; at least 0\.60",
        ),
        (default_plan().widened(0.6), "^track: it crosses itself"),
        (
            rounded_square(0.05),
            r"^track: at centre point \d+ \[.*\] a wall is 0\.05\d away; .* farther than .* 0\.1",
        ),
    ],
)
def test_a_plan_that_is_no_track_says_where_and_why(plan, message):
    with pytest.raises(ValueError, match=message):
        made(plan)


@pytest.mark.parametrize(
    "plan",
    [*(PLANS[name]() for name in PLANS), oval(4.0, 3.2), oval(4.0, 15.0), oval(1.0, 20.0, 3.0)],
)
def test_no_step_leads_between_two_points_of_a_wall(plan):
    track = made(plan)
    left = np.stack([-np.sin(plan.angles), np.cos(plan.angles)], axis=-1)
    for side in (plan.points + plan.half_width * left, plan.points - plan.half_width * left):
        step = np.roll(side, -1, axis=0) - side
        across = step[:, ::-1] * [1, -1] / np.maximum(np.linalg.norm(step, axis=-1), 1e-9)[:, None]
        for end in (-FASTEST / 2, FASTEST / 2):
            assert nearest(track.walls, side + step / 2 + end * across).max() < RADIUS


def test_walls_with_holes_are_refused():
    plan = circle_plan()
    thin = replace(plan, points=plan.points[::4], angles=plan.angles[::4])
    says = r"^track: at centre point \d+ points of a wall are 0\.23\d apart; .* must exceed 0\.12"
    with pytest.raises(ValueError, match=says):
        made(thin)
    with pytest.raises(
        ValueError, match=r"points of a wall are 0\.058 .* 0\.055, must exceed 0\.0577"
    ):
        make_track(plan, 0.055, FASTEST, REACH)
    make_track(plan, 0.058, FASTEST, REACH)


def test_a_point_that_is_its_own_neighbour_is_refused():
    plan = circle_plan()
    closed = replace(
        plan,
        points=np.concatenate([plan.points, plan.points[:1]]),
        angles=np.concatenate([plan.angles, plan.angles[:1]]),
    )
    with pytest.raises(
        ValueError, match=r"^track: centre points 360 and 0 are one; .* must differ"
    ):
        made(closed)


def test_the_last_point_of_a_closed_plan_leads_onward():
    plan = TrackPlan().straight(2).curve(1, -180).straight(3).close(radius=1)
    track = made(plan)
    np.testing.assert_allclose(track.onward[-1], [1, 0], atol=0.05)


def test_close_turns_left_from_above():
    plan = TrackPlan().straight(2).curve(1, 180).straight(3).close(radius=1)
    track = made(plan)
    assert track.centre[:, 1].min() >= -1e-6


@pytest.mark.parametrize("degrees", [float("nan"), float("inf")])
def test_degrees_that_are_not_finite_are_named(degrees):
    with pytest.raises(ValueError, match=f"^curve: degrees is {degrees}"):
        TrackPlan().curve(1, degrees)


def test_plans_of_the_same_track_are_equal_and_have_one_hash():
    plans = [plan() for plan in tracks.PLANS.values()]
    for i, one in enumerate(plans):
        again = list(tracks.PLANS.values())[i]()
        assert one == again
        assert hash(one) == hash(again)
        assert all(one != other for k, other in enumerate(plans) if k != i)
    assert plans[0].widened(0.25) == tracks.narrowed_plan()
    assert plans[0] != "default"
    assert {plans[0]: 1}[tracks.default_plan()] == 1
