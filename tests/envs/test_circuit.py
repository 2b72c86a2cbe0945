import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rp_jax.envs import circuit
from rp_jax.envs.tracks import TrackPlan
from rp_jax.kinematics import Vehicle, angle_of, make_vehicle, to_ego
from rp_jax.sensing import FAR

KEY = jax.random.key(0)
COAST = 7  # neither acceleration nor turn
step = jax.jit(jax.vmap(circuit.step, (None, 0, 0, None)))
begin = jax.jit(jax.vmap(circuit.start_at, (0, None)))
observe = jax.jit(jax.vmap(circuit.observe, (0, None)))


@functools.lru_cache
def params_of(track="default", fidelity="released"):
    return circuit.make_params(track, fidelity=fidelity)


def coast(agents, params):
    """(reached, outcome) of a batch of agents that neither brake nor turn."""
    states = begin(agents, params)
    return step(KEY, states, jnp.full(len(agents.speed), COAST), params)


def lap(params, backwards=False):
    """Agents (n / 4,) that each coast from a point of the centre line to the fourth after it."""
    points = np.asarray(params.track.centre, np.float64)
    points = points[np.append(np.arange(0, len(points), 4), 0)]
    points = points[::-1] if backwards else points
    way = np.diff(points, axis=0)
    length = np.linalg.norm(way, axis=-1)
    real = lambda a: jnp.asarray(a, float)  # noqa: E731
    heading = real(way / length[:, None])
    return Vehicle(position=real(points[:-1]), heading=heading, speed=real(length))


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("track", ["default", "circle"])
def test_a_lap_along_the_centre_line_earns_every_point_of_it_once(track, backwards):
    released, paper = params_of(track), params_of(track, "paper")
    agents, count = lap(released, backwards), len(released.track.centre)
    sign = -1 if backwards else 1
    earned = np.asarray(coast(agents, paper)[1].reward)
    assert earned.sum() == sign * count
    assert (sign * earned > 0).all()
    # The released code earns nothing for the stride over the lap line, and the rest alike.
    other = np.asarray(coast(agents, released)[1].reward)
    across = np.flatnonzero(other != earned)
    assert across.tolist() == [0 if backwards else len(agents.speed) - 1]
    assert other[across] == 0
    assert other.sum() == sign * count - earned[across]


@pytest.mark.parametrize(("fidelity", "expected"), [("released", 0.0), ("paper", 4.0)])
def test_crossing_the_lap_line_counts_in_the_paper_only(fidelity, expected):
    params = params_of("circle", fidelity)
    track = params.track
    for start, sign in ((-2, 1.0), (2, -1.0)):
        heading = sign * (track.centre[-start] - track.centre[start])
        heading = sign * heading / jnp.linalg.norm(heading)
        chord = 2 * 3.0 * np.sin(np.radians(2))
        vehicle = Vehicle(
            position=track.centre[start][None], heading=heading[None], speed=jnp.full(1, chord)
        )
        _, outcome = coast(vehicle, params)
        np.testing.assert_allclose(outcome.reward, [sign * expected])


@pytest.mark.parametrize(("speed", "cost"), [(0.0, 1), (0.004, 1), (-0.004, 1), (0.006, 0)])
def test_standing_still_costs_one(speed, cost):
    params = params_of("circle")
    place, ahead = params.track.centre[90], angle_of(params.track.direction[90])
    agents = make_vehicle(place[None], ahead[None], jnp.full(1, speed))
    reached, outcome = coast(agents, params)
    np.testing.assert_array_equal(outcome.reward, [-cost])
    assert reached.index == 90


def test_the_speed_that_counts_as_standing_is_that_after_the_step():
    params = params_of("circle")
    agents = make_vehicle(params.track.centre[:2], [0.0, 0.0], [0.02, 0.0])
    brake, speed_up = 2, 12
    _, outcome = step(KEY, begin(agents, params), jnp.asarray([brake, speed_up]), params)
    np.testing.assert_array_equal(outcome.reward, [-1, 0])


def test_what_counts_as_standing_can_be_swept_by_vmap():
    params = params_of("circle")
    axes = jax.tree.map(lambda _: None, params).replace(stop_speed=0)
    agents = make_vehicle(params.track.centre[0], 0.0, 0.04)
    state = jax.jit(circuit.start_at)(agents, params)
    sweep = jax.jit(jax.vmap(circuit.step, (None, None, None, axes)))
    swept = params.replace(stop_speed=jnp.asarray([0.005, 0.05]))
    _, outcome = sweep(KEY, state, jnp.asarray(COAST), swept)
    np.testing.assert_array_equal(outcome.reward, [1, 0])


def test_a_wall_nearer_than_the_radius_is_a_crash():
    params = params_of("circle")
    # Wall points stand at radius 3.3 around (0, 3).
    x = jnp.asarray([3.19, 3.21, 3.3, 3.39, 3.41])
    agents = make_vehicle(jnp.stack([x, jnp.full(5, 3.0)], axis=-1), jnp.zeros(5), jnp.zeros(5))
    _, outcome = coast(agents, params)
    np.testing.assert_array_equal(outcome.danger, [0, 1, 1, 1, 0])
    np.testing.assert_array_equal(outcome.terminated, [0, 1, 1, 1, 0])
    assert not outcome.goal.any()


def test_states_far_from_the_track_can_be_stepped_and_observed():
    params = params_of()
    rng = np.random.default_rng(0)
    agents = make_vehicle(rng.uniform(-60, 60, (64, 2)), rng.uniform(-9, 9, 64), np.full(64, 7.0))
    reached, outcome = coast(agents, params)
    seen = observe(reached, params)
    assert np.isfinite(seen).all()
    assert np.isfinite(outcome.reward).all()
    assert ((reached.index >= 0) & (reached.index < 1253)).all()
    np.testing.assert_allclose(reached.agent.speed, 0.1, atol=1e-6)


def test_the_demonstration_starts_at_the_first_centre_point_along_the_track_at_rest():
    state = circuit.demo_start(params_of())
    np.testing.assert_allclose(state.agent.position, [0, 0], atol=1e-6)
    np.testing.assert_allclose(state.agent.heading, [1, 0], atol=1e-6)
    assert (state.agent.speed, state.index, state.time) == (0, 0, 0)


def test_episodes_start_anywhere_on_the_centre_line_within_45_degrees_of_it_at_rest():
    params = params_of()
    keys = jax.random.split(jax.random.key(1), 4000)
    states = jax.jit(jax.vmap(circuit.reset, (0, None)))(keys, params)
    track = params.track
    offset = states.agent.position - track.centre[states.index]
    assert np.abs(offset).max() < 0.02  # the nearest centre point, where two coincide
    angle = np.asarray(angle_of(to_ego(states.agent.heading, track.direction[states.index])))
    assert np.abs(angle).max() <= np.pi / 4 + 1e-4
    assert stats.kstest(angle, stats.uniform(-np.pi / 4, np.pi / 2).cdf).pvalue > 1e-4
    counts = np.histogram(states.index, bins=np.linspace(0, 1253, 8))[0]
    assert stats.chisquare(counts).pvalue > 1e-4
    assert (states.agent.speed == 0).all()
    assert (states.time == 0).all()
    np.testing.assert_allclose(jnp.linalg.norm(states.agent.heading, axis=-1), 1, atol=1e-5)


def test_the_observation_holds_the_scan_the_place_the_bend_and_the_speed():
    params = params_of("circle")
    i = 90  # at (3, 3), the track leads along +y; the heading is .2 to the right of it
    agents = make_vehicle(params.track.centre[i][None], [np.pi / 2 - 0.2], [0.04])
    seen = np.asarray(observe(begin(agents, params), params))[0]
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
    agents = make_vehicle(params.track.centre[:360:5], np.linspace(-3, 3, 72), np.zeros(72))
    seen = observe(begin(agents, params), params)
    assert np.abs(seen[:, 362]).max() <= np.pi + 1e-6


def test_every_wall_point_within_the_threats_window_is_a_hazard():
    params = params_of()
    track, window = jax.device_get((params.track, params.wall.window))
    rng = np.random.default_rng(2)
    where = track.centre[rng.integers(1253, size=200)] + rng.uniform(-0.2, 0.2, (200, 2))
    agents = make_vehicle(where, rng.uniform(-3, 3, 200), np.zeros(200))
    states = begin(agents, params)
    hazards = jax.jit(jax.vmap(circuit.hazards, (0, None)))(states, params)["wall"]
    points, present = jax.device_get(hazards)
    np.testing.assert_array_equal(present, points[..., 0] < FAR)

    def inside(points):
        offset = points - np.asarray(agents.position)[:, None]
        c, s = np.asarray(agents.heading).T[..., None]
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
        ({"radius": -0.1}, r"^radius is -0\.1; it must be a finite number, above 0"),
        ({"beta": 1.5}, r"^beta is 1\.5; it must be a finite number, above 0, at most 1"),
        ({"radius": 0.3}, r"^track: half_width is 0\.3; it must exceed .* radius, 0\.3"),
    ],
)
def test_parameters_out_of_range_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        circuit.make_params(**settings)


def test_there_are_fifteen_actions_of_three_accelerations_and_five_turns():
    params = params_of()
    assert circuit.num_actions(params) == 15
    np.testing.assert_allclose(params.agent.actions.acceleration[::5], [-0.02, 0, 0.02])
    turns = angle_of(params.agent.actions.rotation[:5])
    np.testing.assert_allclose(turns, [-0.15, -0.05, 0, 0.05, 0.15], atol=1e-6)
