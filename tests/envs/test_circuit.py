import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rp_jax.dynamics import Vehicle, angle_of, to_body_frame
from rp_jax.envs import circuit
from rp_jax.envs.sensing import FAR
from rp_jax.envs.tracks import TrackPlan

COAST = 7  # neither acceleration nor turn
ROWS = 320  # of every batch, so that all tests of a track share a compilation


@functools.lru_cache
def params_of(track="default", fidelity="released"):
    return circuit.make_params(track, fidelity=fidelity)


def at(positions, headings=0.0, speeds=0.0):
    """Vehicles from numbers, without any computation on a device."""
    positions = np.asarray(positions, np.float32)
    full = lambda value: np.broadcast_to(np.float32(value), positions.shape[:-1])  # noqa: E731
    angle = full(headings)
    heading = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return Vehicle(position=positions, heading=heading, speed=full(speeds))


@jax.jit
def _drive(bodies, actions, params):
    states = jax.vmap(circuit.start_at, (0, None))(bodies, params)
    step = jax.vmap(circuit.step, (None, 0, 0, None))
    reached, outcome = step(jax.random.key(0), states, actions, params)
    seen = jax.vmap(circuit.observe, (0, None))(states, params)
    return states, reached, outcome, seen


def drive(bodies, params, actions=COAST):
    """(states, reached, outcome, observations of the states) of up to 320 agents."""
    count = len(bodies.speed)
    pad = lambda a: np.concatenate([a, np.repeat(a[-1:], ROWS - count, axis=0)])  # noqa: E731
    actions = np.broadcast_to(np.int32(actions), count)
    done = jax.device_get(_drive(jax.tree.map(pad, bodies), pad(actions), params))
    return jax.tree.map(lambda a: a[:count], done)


def coast(bodies, params):
    """(reached, outcome) of agents that neither brake nor turn."""
    return drive(bodies, params)[1:3]


def lap(params, backwards=False):
    """Agents (n / 4,) that each coast from a point of the centre line to the fourth after it."""
    points = np.asarray(params.track.centre)
    points = points[np.append(np.arange(0, len(points), 4), 0)]
    points = points[::-1] if backwards else points
    way = np.diff(points, axis=0)
    return at(points[:-1], np.arctan2(way[:, 1], way[:, 0]), np.linalg.norm(way, axis=-1))


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("track", ["default", "circle"])
def test_a_lap_along_the_centre_line_earns_every_point_of_it_once(track, backwards):
    released, paper = params_of(track), params_of(track, "paper")
    bodies, count = lap(released, backwards), len(released.track.centre)
    sign = -1 if backwards else 1
    earned = np.asarray(coast(bodies, paper)[1].reward)
    assert earned.sum() == sign * count
    assert (sign * earned > 0).all()
    # The released code earns nothing for the stride over the lap line, and the rest alike.
    other = np.asarray(coast(bodies, released)[1].reward)
    across = np.flatnonzero(other != earned)
    assert across.tolist() == [0 if backwards else len(bodies.speed) - 1]
    assert other[across] == 0
    assert other.sum() == sign * count - earned[across]


@pytest.mark.parametrize(("fidelity", "expected"), [("released", 0.0), ("paper", 4.0)])
def test_crossing_the_lap_line_counts_in_the_paper_only(fidelity, expected):
    params = params_of("circle", fidelity)
    centre = np.asarray(params.track.centre)
    # Four degrees of the circle at once, forwards and backwards.
    first, last = centre[[-2, 2]], centre[[2, -2]]
    way = last - first
    bodies = at(first, np.arctan2(way[:, 1], way[:, 0]), np.linalg.norm(way, axis=-1))
    np.testing.assert_allclose(coast(bodies, params)[1].reward, [expected, -expected])


def test_standing_still_costs_one():
    params = params_of("circle")
    place = np.repeat(np.asarray(params.track.centre)[90][None], 4, axis=0)
    reached, outcome = coast(at(place, np.pi / 2, [0.0, 0.004, -0.004, 0.006]), params)
    np.testing.assert_array_equal(outcome.reward, [-1, -1, -1, 0])
    np.testing.assert_array_equal(reached.index, [90] * 4)


def test_the_speed_that_counts_as_standing_is_that_after_the_step():
    params = params_of("circle")
    bodies = at(np.zeros((2, 2)), 0.0, [0.02, 0.0])
    brake, speed_up = 2, 12
    _, _, outcome, _ = drive(bodies, params, [brake, speed_up])
    np.testing.assert_array_equal(outcome.reward, [-1, 0])


def test_what_counts_as_standing_is_a_parameter():
    params = params_of("circle").replace(stop_speed=jnp.asarray(0.05, float))
    _, outcome = coast(at([[0.0, 0.0]] * 2, 0.0, [0.04, 0.06]), params)
    np.testing.assert_array_equal(outcome.reward, [0, 1])  # a point passed, less 1 for the first


def test_a_wall_nearer_than_the_radius_is_a_crash():
    params = params_of("circle")
    # Wall points stand at radius 3.3 around (0, 3).
    places = [[x, 3.0] for x in (3.19, 3.21, 3.3, 3.39, 3.41)]
    _, outcome = coast(at(places), params)
    np.testing.assert_array_equal(outcome.danger, [0, 1, 1, 1, 0])
    np.testing.assert_array_equal(outcome.terminated, [0, 1, 1, 1, 0])
    assert not outcome.goal.any()


def test_states_far_from_the_track_can_be_stepped_and_observed():
    params = params_of()
    rng = np.random.default_rng(0)
    bodies = at(rng.uniform(-60, 60, (64, 2)), rng.uniform(-9, 9, 64), 7.0)
    _, reached, outcome, seen = drive(bodies, params)
    assert np.isfinite(seen).all()
    assert np.isfinite(outcome.reward).all()
    assert ((reached.index >= 0) & (reached.index < 1253)).all()
    np.testing.assert_allclose(reached.body.speed, 0.1, atol=1e-6)


def test_the_demonstration_starts_at_the_first_centre_point_along_the_track_at_rest():
    state = circuit.demo_start(params_of())
    np.testing.assert_allclose(state.body.position, [0, 0], atol=1e-6)
    np.testing.assert_allclose(state.body.heading, [1, 0], atol=1e-6)
    assert (state.body.speed, state.index, state.time) == (0, 0, 0)


def test_episodes_start_anywhere_on_the_centre_line_within_45_degrees_of_it_at_rest():
    params = params_of()
    keys = jax.random.split(jax.random.key(1), 4000)
    states = jax.device_get(jax.jit(jax.vmap(circuit.reset, (0, None)))(keys, params))
    track = jax.device_get(params.track)
    offset = states.body.position - track.centre[states.index]
    assert np.abs(offset).max() < 0.02  # the nearest centre point, where two coincide
    angle = np.asarray(angle_of(to_body_frame(states.body.heading, track.direction[states.index])))
    assert np.abs(angle).max() <= np.pi / 4 + 1e-4
    assert stats.kstest(angle, stats.uniform(-np.pi / 4, np.pi / 2).cdf).pvalue > 1e-4
    counts = np.histogram(states.index, bins=np.linspace(0, 1253, 8))[0]
    assert stats.chisquare(counts).pvalue > 1e-4
    assert (states.body.speed == 0).all()
    assert (states.time == 0).all()
    np.testing.assert_allclose(np.linalg.norm(states.body.heading, axis=-1), 1, atol=1e-5)


def test_the_observation_holds_the_scan_the_place_the_bend_and_the_speed():
    params = params_of("circle")
    i = 90  # at (3, 3), the track leads along +y; the heading is .2 to the right of it
    bodies = at(np.asarray(params.track.centre)[i][None], np.pi / 2 - 0.2, 0.04)
    seen = drive(bodies, params)[3][0]
    np.testing.assert_allclose(seen[360:362], [3, 3], atol=1e-5)
    onward = np.radians(90.5) - (np.pi / 2 - 0.2)
    np.testing.assert_allclose(seen[362:], [onward, 0.04], atol=1e-4)
    right = round(180 - 90 + np.degrees(0.2))
    left = round(180 + 90 + np.degrees(0.2))
    for side in (right, left):
        near = seen[side - 4 : side + 4]
        np.testing.assert_allclose(near[near > 0].min(), 0.3, atol=0.005)


def test_the_bend_stays_within_half_a_turn():
    params = params_of("circle")
    bodies = at(np.asarray(params.track.centre)[::5], np.linspace(-3, 3, 72))
    seen = drive(bodies, params)[3]
    assert np.abs(seen[:, 362]).max() <= np.pi + 1e-6


def test_every_wall_point_within_the_threats_window_is_a_hazard():
    params = params_of()
    track, window = jax.device_get((params.track, params.wall.window))
    rng = np.random.default_rng(2)
    where = track.centre[rng.integers(1253, size=200)] + rng.uniform(-0.2, 0.2, (200, 2))
    bodies = at(where, rng.uniform(-3, 3, 200))
    states = drive(bodies, params)[0]
    hazards = jax.jit(jax.vmap(circuit.hazards, (0, None)))(states, params)["wall"]
    points, present = jax.device_get(hazards)
    np.testing.assert_array_equal(present, points[..., 0] < FAR)

    def inside(points):
        offset = points - bodies.position[:, None]
        c, s = bodies.heading.T[..., None]
        x, y = offset[..., 0] * c + offset[..., 1] * s, offset[..., 1] * c - offset[..., 0] * s
        return window.contains(np.stack([x, y], axis=-1))

    expected = inside(track.walls[None]).sum(axis=1)
    np.testing.assert_array_equal((inside(points) & present).sum(axis=1), expected)
    assert (expected > 0).mean() > 0.9


def test_a_plan_of_ones_own_is_driven_like_the_others():
    plan = TrackPlan().straight(1.0).curve(0.8, 180).straight(1.0).curve(0.8, 180)
    params = circuit.make_params(plan, fidelity="paper")
    assert coast(lap(params), params)[1].reward.sum() == len(plan.points)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"fidelity": "exact"}, "^fidelity is 'exact'; it must be one of 'released', 'paper'"),
        ({"track": "oval"}, "^track is 'oval'; it must be one of 'default', 'narrowed', 'circle'"),
        ({"time_limit": 0}, "^time_limit is 0; it must be an integer, above 0"),
        ({"time_limit": 1.5}, r"^time_limit is 1\.5; it must be an integer"),
        ({"horizon": 0}, "^horizon is 0; it must be an integer, above 0"),
        ({"radius": -0.1}, r"^radius is -0\.1; it must be a finite number, above 0\.05"),
        ({"beta": 1.5}, r"^beta is 1\.5; it must be a finite number, above 0, at most 1"),
        (
            {"hide_position": 1.5},
            r"^hide_position is 1\.5; it must be a finite number, at least 0, at most 1",
        ),
        ({"radius": 0.3}, r"^track: half_width is 0\.3; it must exceed .* radius, 0\.3"),
    ],
)
def test_parameters_out_of_range_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        circuit.make_params(**settings)


def test_there_are_fifteen_actions_of_three_accelerations_and_five_turns():
    params = params_of()
    assert circuit.num_actions(params) == 15
    np.testing.assert_allclose(params.body.actions.acceleration[::5], [-0.02, 0, 0.02])
    turns = angle_of(params.body.actions.rotation[:5])
    np.testing.assert_allclose(turns, [-0.15, -0.05, 0, 0.05, 0.15], atol=1e-6)


def test_who_is_lost_does_not_see_x_and_y_throughout_the_episode_and_all_else_alike():
    params = params_of()
    keys = jax.random.split(jax.random.key(0), ROWS)

    @jax.jit
    def two_steps(chance):
        of = params.replace(hide_position=chance)
        state = jax.vmap(circuit.reset, (0, None))(keys, of)
        seen = [jax.vmap(circuit.observe, (0, None))(state, of)]
        for action in (12, 14):
            moved = jax.vmap(circuit.step, (0, 0, None, None))
            state, _ = moved(keys, state, action, of)
            seen.append(jax.vmap(circuit.observe, (0, None))(state, of))
        return state.hide_position, jnp.stack(seen)

    _, told = two_steps(0.0)
    for chance in (0.0, 0.25, 1.0):
        hide_position, seen = two_steps(chance)
        assert stats.binomtest(int(hide_position.sum()), ROWS, chance).pvalue > 1e-6
        place = np.where(np.asarray(hide_position)[:, None], 0.0, told[..., 360:362])
        np.testing.assert_array_equal(seen[..., 360:362], place)
        rest = np.delete(np.arange(364), (360, 361))
        np.testing.assert_array_equal(seen[..., rest], told[..., rest])
    assert (np.abs(told[..., 360:362]).sum(axis=-1) > 0).any(axis=0).all()
