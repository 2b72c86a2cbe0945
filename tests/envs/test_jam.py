import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rp_jax.dynamics import Control, Vehicle, angle_of
from rp_jax.envs import contract, jam
from rp_jax.envs.sensing import FAR

COAST = 7  # neither acceleration nor turn
AWAY = (1.5, 1.5)  # where no wall, zone or exit is near
ROWS = 20  # of most batches, so that tests share compilations
step = jax.jit(jax.vmap(jam.step, (0, 0, 0, None)))
reset = jax.jit(jax.vmap(jam.reset, (0, None)))
observe = jax.jit(jax.vmap(jam.observe, (0, None)))


@functools.lru_cache
def params_of(num_obstacles=8, fidelity="released"):
    return jam.make_params(num_obstacles, fidelity=fidelity)


def keys_of(seed, count):
    return jax.random.split(jax.random.key(seed), count)


def still(count):
    return np.full(count, COAST, np.int32)


def at(positions, headings=0.0, speeds=0.0):
    """Vehicles from numbers, without any computation on a device."""
    positions = np.asarray(positions, np.float32)
    full = lambda value: np.broadcast_to(np.float32(value), positions.shape[:-1])  # noqa: E731
    angle = full(headings)
    heading = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return Vehicle(position=positions, heading=heading, speed=full(speeds))


@jax.jit
def _settle(body, obstacles, draws, params):
    state = jam.start_at(body, obstacles, params)
    reached, outcome = jam.transition(state, jnp.asarray(COAST), draws, params)
    return reached, outcome, jam.collisions(reached, params)


def settled(body, places, fidelity="released"):
    """(state, outcome, causes) after a step in which the obstacles stand still at `places`.

    There are always 17 of them, so that all tests share a compilation: the last place is
    repeated. Whatever is relocated goes to (77, 77), where nothing else can be.
    """
    places = [*places, *[places[-1]] * (17 - len(places))]
    straight = np.tile(np.float32([1, 0]), (17, 1))
    controls = Control(acceleration=np.zeros(17, np.float32), rotation=straight)
    draws = jam.Draws(controls=controls, relocated=at(np.full((17, 2), 77.0)))
    return jax.device_get(_settle(body, at(places), draws, params_of(17, fidelity)))


def driven_by(row_keys, t):
    """The keys and actions of step `t`: agents stay where obstacles are about, turning left."""
    keys = jax.vmap(jax.random.fold_in, (0, None))(row_keys, t)
    return keys, jnp.where(t < 3, 12, 9) * jnp.ones(len(row_keys), jnp.int32)


@functools.partial(jax.jit, static_argnums=2)
def drive(row_keys, params, steps):
    """States (steps + 1, rows) of agents that nothing stops."""

    def move(states, t):
        keys, actions = driven_by(row_keys, t)
        reached, _ = jax.vmap(jam.step, (0, 0, 0, None))(keys, states, actions, params)
        return reached, states

    starts = jax.vmap(jam.reset, (0, None))(row_keys, params)
    end, before = jax.lax.scan(move, starts, jnp.arange(steps))
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), before, end)


@functools.lru_cache
def driven(num_obstacles):
    return jax.device_get(drive(keys_of(0, ROWS), params_of(num_obstacles), 120))


def driven_to(states):
    """Where obstacles come to if nothing is relocated."""
    others = jax.tree.map(lambda a: a[:-1], states.obstacles)
    return others.position + others.heading * others.speed[..., None]


def jumps(states):
    """(steps, rows, N) whether an obstacle was relocated."""
    return np.abs(states.obstacles.position[1:] - driven_to(states)).max(axis=-1) > 1e-5


def same_bits(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def first(states, count):
    """States of the first obstacles alone."""
    some = jax.tree.map(lambda a: a[:, :, :count], (states.obstacles, states.present))
    return states.replace(obstacles=some[0], present=some[1])


def test_an_obstacle_moves_alike_to_the_bit_among_however_many():
    many, single = driven(15), driven(1)
    assert jumps(single).sum() > 20
    same_bits(first(many, 1), single)


def test_three_obstacles_are_moved_by_a_step_like_the_first_of_fifteen():
    params, few = params_of(3), first(driven(15), 3)
    rows = keys_of(0, ROWS)
    at_time = lambda t: jax.tree.map(lambda a: a[t], few)  # noqa: E731
    same_bits(jax.device_get(reset(rows, params)), at_time(0))
    relocations = jumps(few).any(axis=2).sum(axis=1)
    for t in np.argsort(-relocations)[:5]:
        assert relocations[t] > 0
        keys, actions = driven_by(rows, t)
        same_bits(jax.device_get(step(keys, at_time(t), actions, params))[0], at_time(t + 1))


def test_obstacles_differ_from_one_another_and_from_row_to_row():
    states = driven(15)
    place = states.obstacles.position[-1].reshape(-1, 2)
    assert len(np.unique(place.round(5), axis=0)) == len(place)


def test_relocated_obstacles_appear_inside_the_room_away_from_the_agent():
    states = driven(15)
    moved = jumps(states)
    assert moved.sum() > 300
    place = states.obstacles.position[1:]
    gap = np.linalg.norm(place - states.body.position[1:, :, None], axis=-1)
    assert gap[moved].min() >= 1.0 - 1e-6
    assert place.min() > 0.1
    assert place.max() < 2.9
    speeds = states.obstacles.speed[1:][moved]
    on_grid = np.abs(speeds[:, None] - np.asarray(jam.OBSTACLE_SPEEDS)).min(axis=1) < 1e-6
    assert on_grid.all()


def test_obstacles_that_leave_are_moved_at_once_and_no_others_are():
    states = driven(15)
    moved = jumps(states)
    there = driven_to(states)
    outside = ((there <= 0.1) | (there >= 2.9)).any(axis=-1)
    offset = np.abs(there[..., None, :] - np.asarray([[0.0, 0.0], [0.0, 3.0], [3.0, 0.0]]))
    gone = outside | (offset < 0.5).all(axis=-1).any(axis=-1)
    near = np.abs(offset - 0.5).min(axis=(-1, -2)) < 1e-5
    near |= np.minimum(np.abs(there - 0.1), np.abs(there - 2.9)).min(axis=-1) < 1e-5
    assert near.sum() < 50  # of 36,000
    np.testing.assert_array_equal(moved[~near], gone[~near])


def test_episodes_start_in_the_corner_and_obstacles_anywhere_a_unit_away():
    states = jax.device_get(reset(keys_of(1, 2000), params_of(8)))
    body, others = states.body, states.obstacles
    np.testing.assert_allclose(body.position, np.full((2000, 2), 0.2), atol=1e-7)
    np.testing.assert_array_equal(body.heading, np.tile([1.0, 0.0], (2000, 1)))
    assert not body.speed.any()
    assert not states.time.any()
    assert states.present.all()
    np.testing.assert_array_equal(states.progress, np.full(2000, -74.0))  # 20 sqrt(2.4^2 + 2.8^2)

    place = others.position.reshape(-1, 2)
    assert np.linalg.norm(place - 0.2, axis=-1).min() >= 1 - 1e-6
    assert place.min() >= 0.1 - 1e-6
    assert place.max() <= 2.9 + 1e-6
    # Uniform: where x > 1.3 nothing is too near to the agent.
    right = place[place[:, 0] > 1.3]
    assert stats.kstest(right[:, 0], "uniform", (1.3, 1.6)).pvalue > 1e-4
    assert stats.kstest(right[:, 1], "uniform", (0.1, 2.8)).pvalue > 1e-4
    grid = np.stack(np.meshgrid(*[np.linspace(0.1, 2.9, 2001)] * 2), axis=-1).reshape(-1, 2)
    free = np.linalg.norm(grid - 0.2, axis=-1) >= 1
    expected = (grid[free, 0] > 1.3).mean()
    assert stats.binomtest(len(right), len(place), expected).pvalue > 1e-4
    angle = np.arctan2(others.heading[..., 1], others.heading[..., 0]).reshape(-1)
    assert stats.kstest(angle, "uniform", (-np.pi, 2 * np.pi)).pvalue > 1e-4
    speeds, counts = np.unique(others.speed, return_counts=True)
    np.testing.assert_allclose(speeds, jam.OBSTACLE_SPEEDS, atol=1e-7)
    assert stats.chisquare(counts).pvalue > 1e-4


def test_obstacles_are_drawn_independently_of_one_another():
    place = jax.device_get(reset(keys_of(1, 2000), params_of(8))).obstacles.position
    correlation = np.corrcoef(place[..., 0].T)
    assert np.abs(correlation - np.eye(8)).max() < 4 / np.sqrt(2000)


def test_obstacles_drive_by_the_frequencies_of_the_paper():
    states = driven(15)
    stayed = ~jumps(states)
    speed = states.obstacles.speed
    complex_heading = states.obstacles.heading[..., 0] + 1j * states.obstacles.heading[..., 1]
    turns = np.angle(complex_heading[1:] / complex_heading[:-1])[stayed]
    np.testing.assert_allclose(np.unique(turns.round(4)), [-0.15, -0.05, 0, 0.05, 0.15])
    faster = (speed[1:] - speed[:-1])[stayed]
    kind = 5 * np.digitize(faster, (-0.01, 0.01)) + np.digitize(turns, (-0.1, -0.03, 0.03, 0.1))
    # Where the speed is not at a limit, every acceleration shows.
    free = np.abs(speed[:-1][stayed] - 0.03) < 0.02
    expected = np.outer([0.2, 0.6, 0.2], [0.2] * 5).reshape(-1) * free.sum()
    assert free.sum() > 5000
    assert stats.chisquare(np.bincount(kind[free], minlength=15), expected).pvalue > 1e-4


# An obstacle's position, and whether it is gone: (released, paper).
PLACES = [
    (AWAY, (False, False)),
    ((0.1, 1.5), (True, True)),
    ((0.101, 1.5), (False, False)),
    ((2.9, 1.5), (True, True)),
    ((1.5, 0.05), (True, True)),
    ((1.5, 2.95), (True, True)),
    ((2.6, 2.95), (True, True)),  # the exit is none for obstacles
    ((0.3, 0.3), (True, True)),
    ((0.3, 2.7), (True, True)),
    ((2.7, 0.3), (True, True)),
    ((2.7, 2.7), (False, False)),  # no zone beside the exit
    ((0.45, 0.45), (True, False)),  # in the square, not in the quarter circle
    ((0.45, 2.55), (True, False)),
    ((2.55, 0.45), (True, False)),
    ((0.52, 0.15), (False, False)),
    ((0.15, 0.47), (True, True)),
    ((0.2, 0.47), (True, False)),
]


def test_released_obstacles_are_relocated_from_outside_and_from_square_zones():
    state, _, _ = settled(at((1.5, 1.0)), [place for place, _ in PLACES])
    relocated = state.obstacles.position[:, 0] == 77.0
    np.testing.assert_array_equal(relocated, [gone for _, (gone, _) in PLACES])
    assert state.present.all()


def test_obstacles_of_the_paper_disappear_outside_and_in_quarter_circles():
    places = [place for place, _ in PLACES]
    state, _, _ = settled(at((1.5, 1.0)), places, "paper")
    np.testing.assert_array_equal(~state.present, [gone for _, (_, gone) in PLACES])
    np.testing.assert_allclose(state.obstacles.position, places, atol=1e-6)
    present = jax.jit(jam.hazards)(state, params_of(17, "paper"))["obstacle"].present
    np.testing.assert_array_equal(present, state.present)


def test_an_obstacle_that_has_disappeared_never_returns_and_hits_nothing():
    params = params_of(3, "paper")
    # The agent stands on the first of three obstacles.
    others = at(np.tile([AWAY, (0.3, 1.5), (1.0, 2.0)], (20, 1, 1)))
    states = reset(keys_of(0, 20), params).replace(body=at([AWAY] * 20), obstacles=others)
    for present, danger in ((True, 1), (False, 0)):
        there = np.tile([present, True, True], (20, 1))
        reached, outcome = step(keys_of(0, 20), states.replace(present=there), still(20), params)
        assert (outcome.danger == danger).all()
        assert (reached.present[:, 0] == present).all()
    for seed in range(3):
        reached, outcome = step(keys_of(seed, 20), reached, still(20), params)
        assert not reached.present[:, 0].any()
        assert not outcome.danger.any()
    seen = np.asarray(observe(reached, params))[:, 360:392].reshape(20, 8, 4)
    unseen = np.abs(seen[..., :2] - np.asarray(jam.UNSEEN)).max(axis=-1) < 1e-6
    np.testing.assert_array_equal(unseen.sum(axis=1), np.full(20, 6))


@pytest.mark.parametrize(("fidelity", "whole"), [("released", True), ("paper", False)])
def test_progress_is_rounded_in_the_released_version_only(fidelity, whole):
    state, outcome, _ = settled(at((1.0, 1.0), 0.8, 0.1), [(2.5, 1.0)], fidelity)
    to_go = np.asarray([2.6, 3.0]) - np.asarray([[1.0, 1.0], state.body.position])
    before, after = -20 * np.linalg.norm(to_go, axis=-1)
    if whole:
        before, after = np.round(before), np.round(after)
    np.testing.assert_allclose(state.progress, after, atol=1e-4)
    np.testing.assert_allclose(outcome.reward, after - before - 0.05, atol=1e-4)
    assert (float(state.progress) == round(float(state.progress))) == whole


@pytest.mark.parametrize("fidelity", contract.FIDELITIES)
def test_rewards_add_up_to_the_progress_made_less_the_costs(fidelity):
    params = params_of(3, fidelity)
    states = reset(keys_of(6, 20), params)
    start, total = states.progress, np.zeros(20)
    for t in range(8):
        states, outcome = step(
            keys_of(t, 20), states, np.full(20, 12 if t < 5 else 9, np.int32), params
        )
        total += np.asarray(outcome.reward)
    # From rest the speed is .02 after the first step: it never stands still.
    np.testing.assert_allclose(total, states.progress - start - 8 * 0.05, atol=1e-3)


@pytest.mark.parametrize(
    ("speed", "cost"), [(0.0, 0.1), (0.004, 0.1), (-0.004, 0.1), (0.006, 0.05)]
)
def test_standing_still_costs_twice_the_price_of_time(speed, cost):
    _, outcome, _ = settled(at((1.5, 1.0), 0.0, speed), [(2.5, 2.0)])
    np.testing.assert_allclose(outcome.reward, -cost, atol=1e-6)


@pytest.mark.parametrize(
    ("position", "goal"), [((2.6, 2.95), True), ((2.4, 2.91), True), ((2.6, 2.89), False)]
)
def test_driving_out_of_the_exit_is_the_goal(position, goal):
    state, outcome, _ = settled(at(position, np.pi / 2, 0.1), [(1.0, 1.0)])
    assert bool(outcome.goal) == bool(outcome.terminated) == goal
    assert outcome.danger == 0
    progress = np.round(20 * np.hypot(position[0] - 2.6, position[1] - 3)) + state.progress
    np.testing.assert_allclose(outcome.reward, progress - 0.05 + 10 * goal, atol=1e-4)


@pytest.mark.parametrize(("fidelity", "reward"), [("released", 9.95), ("paper", -0.05)])
def test_a_crash_in_the_exit_is_a_goal_as_well_if_as_released(fidelity, reward):
    """From .05 below the goal to .05 above it: no progress."""
    state, outcome, hit = settled(at((2.6, 2.95), np.pi / 2, 0.1), [(2.7, 2.89)], fidelity)
    assert hit["obstacle"]
    assert state.body.position[1] > 3
    assert bool(outcome.goal) == (fidelity == "released")
    assert outcome.terminated
    assert outcome.danger == 1
    np.testing.assert_allclose(outcome.reward, reward, atol=1e-4)


@pytest.mark.parametrize(
    ("position", "wall"),
    [
        ((0.11, 1.5), False),
        ((0.09, 1.5), True),
        ((2.95, 1.5), True),
        ((1.5, 0.05), True),
        ((1.5, 2.95), True),
        ((2.6, 2.95), False),
        ((2.25, 2.95), True),  # the edge of the exit
        ((2.95, 2.95), True),
    ],
)
def test_a_wall_point_nearer_than_the_radius_is_a_crash(position, wall):
    _, outcome, hit = settled(at(position), [(1.0, 1.0)])
    assert bool(hit["wall"]) == bool(outcome.danger) == wall
    assert not hit["obstacle"]


@pytest.mark.parametrize(("gap", "crash"), [(0.19, True), (0.21, False)])
def test_centres_nearer_than_two_radii_are_a_crash(gap, crash):
    near = (1.5 + gap * np.cos(1.0), 1.5 + gap * np.sin(1.0))
    _, outcome, hit = settled(at(AWAY), [(2.5, 2.0), near, (2.5, 2.0)])
    assert bool(hit["obstacle"]) == bool(outcome.danger) == crash
    assert not hit["wall"]


@pytest.mark.parametrize("num_obstacles", [3, 50])
def test_the_eight_nearest_obstacles_are_seen_in_the_order_of_their_distance(num_obstacles):
    params = params_of(num_obstacles)
    states = reset(keys_of(7, 20), params)
    rng = np.random.default_rng(0)
    bodies = at(rng.uniform(0.5, 2.5, (20, 2)), rng.uniform(-3, 3, 20), rng.uniform(-0.1, 0.1, 20))
    states = jax.device_get(states.replace(body=bodies))
    seen = np.asarray(observe(states, params), np.float64)[:, 360:]
    turn = lambda vector: vector[..., 0] + 1j * vector[..., 1]  # noqa: E731
    body, others = states.body, states.obstacles
    ahead = turn(body.heading.astype(float))[:, None]
    offset = turn(others.position.astype(float)) - turn(body.position.astype(float))[:, None]
    facing, speed = turn(others.heading.astype(float)), others.speed
    pad = max(0, 8 - num_obstacles)
    if pad:
        offset = np.hstack([offset, np.full((20, pad), turn(np.asarray(jam.UNSEEN)))])
        facing = np.hstack([facing, np.repeat(-ahead, pad, axis=1)])
        speed = np.hstack([speed, np.repeat(body.speed[:, None], pad, axis=1)])
    order = np.argsort(np.abs(offset), axis=1, kind="stable")[:, :8]
    nearest = lambda values: np.take_along_axis(values, order, axis=1)  # noqa: E731
    local, way = nearest(offset / ahead), np.angle(nearest(facing / ahead))
    rows = seen[:, :32].reshape(20, 8, 4)
    np.testing.assert_allclose(rows[..., 0] + 1j * rows[..., 1], local, atol=1e-5)
    np.testing.assert_allclose(np.exp(1j * rows[..., 2]), np.exp(1j * way), atol=1e-5)
    np.testing.assert_allclose(rows[..., 3], nearest(speed), atol=1e-6)
    np.testing.assert_allclose(seen[:, 32:34], body.position, atol=1e-6)
    np.testing.assert_allclose(seen[:, 34], np.angle(ahead[:, 0]), atol=1e-5)
    np.testing.assert_allclose(seen[:, 35], body.speed, atol=1e-6)


def test_fifty_obstacles_can_be_driven_among():
    params = params_of(50)
    states = reset(keys_of(8, 20), params)
    for t in range(5):
        states, outcome = step(keys_of(t, 20), states, np.full(20, 12, np.int32), params)
    assert states.obstacles.position.shape == (20, 50, 2)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((states, outcome)))
    hazards = jax.eval_shape(jax.vmap(jam.hazards, (0, None)), states, params)
    assert hazards["obstacle"].present.shape == (20, 50)


def test_states_far_from_the_room_can_be_stepped_and_observed():
    params = params_of(3)
    states = reset(keys_of(9, 20), params)
    rng = np.random.default_rng(0)
    bodies = at(rng.uniform(-60, 60, (20, 2)), rng.uniform(-9, 9, 20), np.full(20, 7.0))
    others = at(rng.uniform(-60, 60, (20, 3, 2)), 0.0, -3.0)
    states = states.replace(body=bodies, obstacles=others)
    reached, outcome = step(keys_of(0, 20), states, still(20), params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((reached, outcome)))
    assert np.isfinite(observe(reached, params)).all()
    assert (reached.obstacles.position > 0).all()  # brought back into the room
    assert (reached.obstacles.position < 3).all()


def test_an_agent_at_nan_does_not_keep_obstacles_searching_for_a_place():
    params = params_of(3)
    states = reset(keys_of(10, 20), params)
    lost = at(np.full((20, 2), np.nan))
    out = at(np.full((20, 3, 2), -1.0))
    reached, _ = step(keys_of(0, 20), states.replace(body=lost, obstacles=out), still(20), params)
    assert (reached.obstacles.position > 0).all()


def test_every_wall_point_within_the_threats_window_is_a_hazard():
    params = params_of(3)
    rng = np.random.default_rng(1)
    bodies = at(rng.uniform(0.1, 3.1, (200, 2)), rng.uniform(-3, 3, 200), np.zeros(200))
    hazards = jax.jit(jax.vmap(lambda body: jam.hazards(blank(body), params)["wall"]))

    def blank(body):
        return jam.start_at(body, at(np.full((3, 2), 1.5)), params)

    points, present = jax.device_get(hazards(bodies))
    np.testing.assert_array_equal(present, points[..., 0] < FAR)
    window = jax.device_get(params.wall.window)

    def inside(points):
        offset = points - np.asarray(bodies.position)[:, None]
        c, s = np.asarray(bodies.heading).T[..., None]
        x, y = offset[..., 0] * c + offset[..., 1] * s, offset[..., 1] * c - offset[..., 0] * s
        return window.contains(np.stack([x, y], axis=-1))

    expected = inside(jam.wall_points().astype(np.float32)[None]).sum(axis=1)
    np.testing.assert_array_equal((inside(points) & present).sum(axis=1), expected)
    assert (expected > 0).mean() > 0.3


def test_the_walls_stand_around_the_room_but_not_in_the_exit(golden):
    walls = jam.wall_points()
    assert walls.shape == (559, 2) == np.unique(walls.round(9), axis=0).shape
    on_edge = np.isclose(walls, 0) | np.isclose(walls, 3)
    assert on_edge.any(axis=1).all()
    top = walls[np.isclose(walls[:, 1], 3) & (walls[:, 0] > 2.19)]
    assert len(top) == 0
    recorded = np.unique(golden("traces_jam")["wall"].round(9), axis=0)
    np.testing.assert_allclose(np.unique(walls.round(9), axis=0), recorded, atol=1e-9)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"fidelity": "exact"}, "^fidelity is 'exact'; it must be one of 'released', 'paper'"),
        ({"num_obstacles": 0}, "^num_obstacles is 0; it must be an integer, at least 1"),
        ({"num_obstacles": 2.5}, r"^num_obstacles is 2\.5; it must be an integer"),
        ({"num_obstacles": 10_000}, "^num_obstacles is 10000; it must be .* at most 225"),
        ({"num_obstacles": 101, "room": 2}, "^num_obstacles is 101; it must be .* at most 100"),
        ({"room": 1.9}, r"^room is 1\.9; it must be a finite number, at least 2, at most 30"),
        ({"room": float("nan")}, "^room is nan; it must be a finite number"),
        ({"time_limit": -1}, "^time_limit is -1; it must be an integer, above 0"),
        (
            {"radius": 0.5},
            r"^radius is 0\.5; it must be .* above 0\.0509902, at most 0\.2",
        ),
        ({"fewest": -1}, "^fewest is -1; it must be an integer, at least 0, at most 8"),
        ({"fewest": 9}, "^fewest is 9; it must be an integer, at least 0, at most 8"),
        ({"beta": 0}, "^beta is 0; it must be a finite number, above 0, at most 1"),
        ({"wall_horizon": 0}, "^wall_horizon is 0; it must be an integer"),
        ({"obstacle_horizon": 0.5}, r"^obstacle_horizon is 0\.5; it must be an integer"),
    ],
)
def test_parameters_out_of_range_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        jam.make_params(**settings)


@pytest.mark.parametrize("fidelity", ["released", "paper"])
def test_a_larger_room_has_the_same_upper_right_corner(fidelity):
    small, large = params_of(8, fidelity), jam.make_params(8, room=5.5, fidelity=fidelity)
    row_keys = keys_of(7, ROWS)
    states = drive(row_keys, small, 3)
    states = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), states)
    shift = np.float32([[2.5, 2.5]])
    near = jnp.where(jnp.arange(len(states.time)) % 2, 2.9, 2.3)  # at the edge of the exit, and not
    body = states.body.replace(position=jnp.stack([near, near / near + 1.85], axis=-1))
    states = states.replace(body=body)
    moved = states.replace(
        body=body.replace(position=body.position + shift),
        obstacles=states.obstacles.replace(position=states.obstacles.position + shift[None]),
    )
    here, there = observe(states, small), observe(moved, large)
    # Distances of the walls in view; those of the walls that moved away are out of view.
    np.testing.assert_allclose(here[:, :392], there[:, :392], atol=2e-3)
    np.testing.assert_allclose(here[:, 392:394] + shift, there[:, 392:394], atol=1e-5)
    at_small = jax.vmap(jam.collisions, (0, None))(states, small)
    at_large = jax.vmap(jam.collisions, (0, None))(moved, large)
    np.testing.assert_array_equal(at_small["wall"], at_large["wall"])
    np.testing.assert_allclose(small.goal + shift[0], large.goal, atol=1e-6)


def test_obstacles_use_the_whole_of_a_larger_room_and_stay_in_it():
    params = jam.make_params(100, room=8.0)
    states = drive(keys_of(3, 4), params, 40)
    place = np.asarray(states.obstacles.position)
    assert place.min() > 0.1
    assert 7.5 < place.max() < 7.9
    outside = np.asarray(states.body.position)[..., None, :] - place[0]
    assert (np.linalg.norm(outside[0], axis=-1) >= jam.CLEARANCE).all()


def test_the_goal_is_above_the_top_wall_of_a_larger_room():
    params = jam.make_params(8, room=5.5)
    body = at((5.1, 5.48), np.pi / 2, 0.1)
    state = jam.start_at(body, at(np.full((8, 2), 1.5)), params)
    reached, outcome = jax.jit(jam.step)(jax.random.key(0), state, COAST, params)
    assert reached.body.position[1] > 5.5
    assert outcome.goal
    assert outcome.terminated
    # From .02 below the goal (rounded: 0) to .08 above it (1.6, rounded: 2).
    assert outcome.reward == pytest.approx(10 - 0.05 - 2)


def test_episodes_begin_with_as_few_obstacles_as_is_asked_for():
    start = jax.jit(jax.vmap(jam.reset, (0, None)))
    row_keys = keys_of(1, 4000)
    all_of_them = start(row_keys, params_of(8))
    assert all_of_them.present.all()
    some = start(row_keys, jam.make_params(8, fewest=2))
    counts = np.bincount(some.present.sum(axis=1), minlength=9)
    assert (counts[:2] == 0).all()
    assert (np.abs(counts[2:] - 4000 / 7) < 5 * np.sqrt(4000 / 7)).all()
    # The number alone differs.
    jax.tree.map(np.testing.assert_array_equal, some.obstacles, all_of_them.obstacles)
    assert (some.present[:, :-1] >= some.present[:, 1:]).all()  # the first ones


def test_obstacles_that_are_absent_stay_away():
    params = jam.make_params(8, fewest=0)
    states = jax.device_get(drive(keys_of(2, 50), params, 40))
    assert (states.present == states.present[0]).all()
    assert 0 < states.present[0].mean() < 1
    hit = jax.jit(jax.vmap(jax.vmap(jam.collisions, (0, None)), (0, None)))
    nobody = states.replace(present=np.zeros_like(states.present))
    assert not hit(nobody, params)["obstacle"].any()


def test_there_are_fifteen_actions_of_three_accelerations_and_five_turns():
    params = params_of(8)
    assert jam.num_actions(params) == 15
    np.testing.assert_allclose(params.body.actions.acceleration[::5], [-0.02, 0, 0.02])
    turns = angle_of(params.body.actions.rotation[:5])
    np.testing.assert_allclose(turns, [-0.3, -0.1, 0, 0.1, 0.3], atol=1e-6)


def test_giving_a_state_away_leaves_the_parameters():
    params = jam.make_params(8)
    state = jam.reset(jax.random.key(0), params)
    donating = jax.jit(jam.step, donate_argnums=1)
    donating(jax.random.key(1), state, jnp.asarray(COAST), params)
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves(params))
    jam.reset(jax.random.key(0), params)
