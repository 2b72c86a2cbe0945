"""Every recorded transition of the released implementation, replayed.

Strict comparisons flip within rounding of their limit. Such near ties are a property of the
recorded data alone; they are left out and counted, and the counts below are exact.
"""

import jax
import numpy as np
import pytest

from rp_jax.dynamics import Control, Vehicle
from rp_jax.envs import circuit, jam, point_gather

BINS = 360
VALUES = {"float64": 1e-9, "float32": 1e-5}  # tolerance of states and rewards
SEEN = {"float64": 1e-6, "float32": 1e-5}  # of observations, which are recorded in float32
TIE = {"float64": 1e-9, "float32": 1e-5}  # radians from a bin's edge, units from other limits
JAMS = {"traces_jam": 8, "traces_jam_n3": 3, "traces_jam_n15": 15, "traces_jam_exit": 8}
ROWS = {
    "traces_circuit": 1202,
    "traces_jam": 1358,
    "traces_jam_n3": 188,
    "traces_jam_n15": 190,
    "traces_jam_exit": 3,  # the exit is crossed and a wall hit in one step
    "traces_gather": 1366,
}

# LIDAR bins, of 360 a row, left out before and after the step.
TIED_BINS = {
    ("traces_circuit", "float64"): (2, 1),
    ("traces_circuit", "float32"): (830, 813),
    ("traces_jam", "float64"): (492, 242),
    ("traces_jam", "float32"): (681, 463),
    ("traces_jam_n3", "float64"): (141, 111),
    ("traces_jam_n3", "float32"): (176, 142),
    ("traces_jam_n15", "float64"): (80, 30),
    ("traces_jam_n15", "float32"): (106, 60),
    ("traces_jam_exit", "float64"): (0, 0),
    ("traces_jam_exit", "float32"): (0, 0),
}
# Relative headings within a tie of +-pi, before and after: the five obstacles that pad N = 3.
HALF_TURNS = dict.fromkeys(JAMS, (0, 0)) | {"traces_jam_n3": (940, 940)}
# Rows whose two nearest centre points are equally far.
TIED_INDICES = {"float64": 0, "float32": 19}
# Sensor bins, of 20 a row, left out before and after the step.
TIED_SENSORS = {"float64": (0, 0), "float32": (0, 0)}


def real(values):
    return np.asarray(values, jax.dtypes.canonicalize_dtype(float))


def vehicle(data, suffix="", prefix=""):
    return Vehicle(
        position=real(data[f"{prefix}pos{suffix}"]),
        heading=real(data[f"{prefix}front{suffix}"]),
        speed=real(data[f"{prefix}v{suffix}"]),
    )


def same(actual, expected, tolerance):
    actual, expected = np.asarray(actual, np.float64), np.asarray(expected, np.float64)
    assert actual.shape == expected.shape
    gap = np.abs(actual - expected)
    assert (gap <= tolerance).all(), (gap.max(), np.argwhere(~(gap <= tolerance))[:5])


def same_vehicle(actual, data, tolerance, prefix=""):
    same(actual.position, data[f"{prefix}pos_next"], tolerance)
    same(actual.heading, data[f"{prefix}front_next"], tolerance)
    same(actual.speed, data[f"{prefix}v_next"], tolerance)


def ties(values, limit, tolerance):
    return int((np.abs(values - limit) <= tolerance).sum())


def tied_bins(position, front, wall, tolerance):
    """(rows, 360) bins with a point in view near one of their edges, or near the limit of view."""
    tied = np.zeros((len(position), BINS), bool)
    for row, (place, (c, s)) in enumerate(zip(position, front, strict=True)):
        x, y = (wall - place).T
        distance = np.hypot(x, y)
        turn = (np.arctan2(y * c - x * s, x * c + y * s) + np.pi) * BINS / (2 * np.pi)
        edge = np.round(turn).astype(int)
        aside = np.abs(turn - edge) * (2 * np.pi / BINS)
        near = (aside < tolerance) & (distance < 1 + tolerance)
        tied[row, edge[near] % BINS] = True
        tied[row, (edge[near] - 1) % BINS] = True
        rim = np.abs(distance - 1) < tolerance
        tied[row, np.floor(turn[rim]).astype(int) % BINS] = True
    return tied


def same_scan(observed, data, suffix, tied, tolerance):
    gap = np.abs(np.asarray(observed, np.float64) - data[f"obs{suffix}"])[:, :BINS]
    wrong = ~(gap <= tolerance) & ~tied
    assert not wrong.any(), np.argwhere(wrong)[:5]


def same_angles(actual, expected, tolerance):
    """Compares angles near +-pi modulo 2 pi, and returns how many those are."""
    actual = np.asarray(actual, np.float64)
    half_turn = np.pi - np.abs(expected) <= tolerance
    same(
        np.where(half_turn, np.abs(actual), actual), np.where(half_turn, np.pi, expected), tolerance
    )
    return int(half_turn.sum())


def test_the_recorded_data_are_complete(golden):
    assert {name: len(golden(name)["t"]) for name in ROWS} == ROWS


def test_circuit_replays_every_recorded_transition(golden, precision):
    data = golden("traces_circuit")
    count, tolerance, tie = len(data["t"]), VALUES[precision], TIE[precision]
    params = circuit.make_params()
    states = circuit.State(
        body=vehicle(data),
        index=data["prev_index"].astype(np.int32),
        time=np.zeros(count, np.int32),
        hide_position=np.zeros(count, bool),
    )
    step = jax.jit(jax.vmap(circuit.step, (None, 0, 0, None)))
    reached, outcome = step(jax.random.key(0), states, data["action"].astype(np.int32), params)

    same_vehicle(reached.body, data, tolerance)
    assert ties(data["min_wall_dist_next"], 0.1, 1e-5) == 0
    assert ties(np.abs(data["v_next"]), 0.005, 1e-5) == 0
    np.testing.assert_array_equal(outcome.terminated, data["crashed"])
    np.testing.assert_array_equal(outcome.danger, data["crashed"])
    np.testing.assert_array_equal(outcome.done, data["done"])
    assert not outcome.truncated.any()
    assert not outcome.goal.any()

    distance = np.linalg.norm(data["cpos"][None] - data["pos_next"][:, None], axis=-1)
    first, second = np.partition(distance, 1, axis=1)[:, :2].T
    clear = second - first > tie
    assert (~clear).sum() == TIED_INDICES[precision]
    index = np.asarray(reached.index)
    np.testing.assert_array_equal(index[clear], data["prev_index_next"][clear])
    assert (distance[np.arange(count), index] - first <= tie).all()
    reward = np.asarray(outcome.reward - data["lmd"] * outcome.danger)
    same(reward[clear], data["reward"][clear], tolerance)

    observe = jax.jit(jax.vmap(circuit.observe, (0, None)))
    for part, (state, suffix) in enumerate([(states, ""), (reached, "_next")]):
        observed = observe(state, params)
        tied = tied_bins(data[f"pos{suffix}"], data[f"front{suffix}"], data["wall"], tie)
        assert tied.sum() == TIED_BINS["traces_circuit", precision][part]
        same_scan(observed, data, suffix, tied, SEEN[precision])
        rows = clear if part else slice(None)  # the track's direction depends on the index
        rest, expected = observed[rows, BINS:], data[f"obs{suffix}"][rows, BINS:]
        same(np.delete(rest, 2, axis=1), np.delete(expected, 2, axis=1), SEEN[precision])
        assert same_angles(rest[:, 2], expected[:, 2], SEEN[precision]) == 0


@pytest.mark.parametrize("name", JAMS)
def test_jam_replays_every_recorded_transition(golden, precision, name):
    data = golden(name)
    count, tolerance, tie = len(data["t"]), VALUES[precision], TIE[precision]
    params = jam.make_params(JAMS[name])
    states = jam.State(
        body=vehicle(data),
        obstacles=vehicle(data, prefix="cars_"),
        present=np.ones((count, JAMS[name]), bool),
        progress=real(data["prev_progress"]),
        time=np.zeros(count, np.int32),
    )
    omega, moved = data["cars_omega"], data["respawned"]
    # Only what was relocated has a place: relocating anything else would show.
    draws = jam.Draws(
        controls=Control(
            acceleration=real(data["cars_acc"]),
            rotation=real(np.stack([np.cos(omega), np.sin(omega)], axis=-1)),
        ),
        relocated=Vehicle(
            position=real(np.where(moved[..., None], data["cars_pos_next"], 77.0)),
            heading=real(np.where(moved[..., None], data["cars_front_next"], 77.0)),
            speed=real(np.where(moved, data["cars_v_next"], 77.0)),
        ),
    )
    transition = jax.jit(jax.vmap(jam.transition, (0, 0, 0, None)))
    reached, outcome = transition(states, data["action"].astype(np.int32), draws, params)

    # No strict comparison is near its limit, so no row is left out.
    between = np.linalg.norm(data["cars_pos_next"] - data["pos_next"][:, None], axis=-1)
    points = 20 * np.linalg.norm(data["pos_next"] - data["mark_point"], axis=-1)
    assert ties(data["min_wall_dist_next"], 0.1, 1e-5) == 0
    assert ties(between, 0.2, 1e-5) == 0
    assert ties(np.abs(data["v_next"]), 0.005, 1e-5) == 0
    assert ties(points % 1, 0.5, 1e-5) == 0
    assert sum(ties(data["cars_pos_tick"], x, 1e-5) for x in (0.1, 0.5, 2.5, 2.9)) == 0
    assert ties(data["pos_next"][:, 1], 3.0, 1e-5) == 0

    assert moved.any() or name == "traces_jam_exit"
    same_vehicle(reached.body, data, tolerance)
    same_vehicle(reached.obstacles, data, tolerance, prefix="cars_")
    assert reached.present.all()
    same(reached.progress, data["prev_progress_next"], tolerance)
    same(outcome.reward - data["lmd"] * outcome.danger, data["reward"], tolerance)
    np.testing.assert_array_equal(outcome.danger, data["crashed"])
    np.testing.assert_array_equal(outcome.goal, data["goal"])
    np.testing.assert_array_equal(outcome.terminated, data["crashed"] | data["goal"])
    np.testing.assert_array_equal(outcome.done, data["done"])
    hit = jax.jit(jax.vmap(jam.collisions, (0, None)))(reached, params)
    np.testing.assert_array_equal(hit["wall"], data["crashed_wall"])
    np.testing.assert_array_equal(hit["obstacle"], data["crashed_car"])

    observe = jax.jit(jax.vmap(jam.observe, (0, None)))
    angles = np.append(np.arange(362, 392, 4), 394)
    for part, (state, suffix) in enumerate([(states, ""), (reached, "_next")]):
        observed, expected = observe(state, params), data[f"obs{suffix}"]
        tied = tied_bins(data[f"pos{suffix}"], data[f"front{suffix}"], data["wall"], tie)
        assert tied.sum() == TIED_BINS[name, precision][part]
        same_scan(observed, data, suffix, tied, SEEN[precision])
        others = np.setdiff1d(np.arange(BINS, 396), angles)
        same(observed[:, others], expected[:, others], SEEN[precision])
        turns = same_angles(observed[:, angles], expected[:, angles], SEEN[precision])
        assert turns == HALF_TURNS[name][part]


def objects(data, kind, count, suffix=""):
    """The recorded lists of objects, those of one kind first; padded, at (77, 77), to `count`."""
    listed = data[f"objects{suffix}"]
    mine = listed[..., 2] == kind
    rows = np.argsort(~mine, axis=1, kind="stable")[:, :count]
    present = np.take_along_axis(mine, rows, axis=1)
    places = np.take_along_axis(listed[..., :2], rows[..., None], axis=1)
    return point_gather.Objects(real(np.where(present[..., None], places, 77.0)), present)


def gatherers(data, suffix=""):
    """Recorded states of Point Gather; some have three apples."""
    pose, count = data[f"qpos{suffix}"], len(data["t"])
    return point_gather.State(
        body=Vehicle(
            position=real(pose[:, :2]),
            heading=real(np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=-1)),
            speed=real(np.zeros(count)),
        ),
        angle=real(pose[:, 2]),
        velocity=real(data[f"qvel{suffix}"]),
        apples=objects(data, 0, 3, suffix),
        bombs=objects(data, 1, 8, suffix),
        hit=np.zeros(count, bool),
        time=np.zeros(count, np.int32),
    )


def tied_sensors(data, suffix, tolerance):
    """(rows, 20) bins with an object near one of their edges, or near the limit of view."""
    offset = data[f"objects{suffix}"][..., :2] - data[f"com{suffix}"][:, None, :2]
    distance = np.hypot(*np.moveaxis(offset, -1, 0))
    angle = np.arctan2(offset[..., 1], offset[..., 0]) - data[f"qpos{suffix}"][:, 2:]
    place = ((angle + np.pi) % (2 * np.pi) - np.pi / 2) / (np.pi / 10)
    edge = np.round(place)
    aside = np.abs(place - edge) * (np.pi / 10)
    near = (aside < tolerance) & (distance < 6 + tolerance) & (edge >= 0) & (edge <= 10)
    near |= (np.abs(distance - 6) < tolerance) & (place > -0.01) & (place < 10.01)
    tied = np.zeros((len(offset), 20), bool)
    for row, item in np.argwhere(near):
        first = 10 * int(data[f"objects{suffix}"][row, item, 2])
        for index in {int(edge[row, item]) - 1, int(edge[row, item]), int(place[row, item])}:
            if 0 <= index < 10:
                tied[row, first + index] = True
    return tied


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_point_gather_replays_every_recorded_transition(golden, precision, kind):
    data = golden("traces_gather")
    tolerance, tie = VALUES[precision], TIE[precision]
    params = point_gather.make_params(3, 8)
    states, expected = gatherers(data), gatherers(data, "_next")
    if kind == "discrete":
        actions = data["action81"].astype(np.int32)
    else:
        actions = real(data["action"] / [1.0, 0.25])
    step = jax.jit(jax.vmap(point_gather.step, (None, 0, 0, None)))
    reached, outcome = step(jax.random.key(0), states, actions, params)

    # No object is near the limit of reach, so no row is left out.
    place = data["com_next"][:, None, :2]
    assert ties(np.linalg.norm(data["objects"][..., :2] - place, axis=-1), 1.0, 1e-5) == 0
    same(reached.body.position, expected.body.position, tolerance)
    same(reached.body.heading, expected.body.heading, tolerance)
    same(reached.angle, expected.angle, tolerance)
    same(reached.velocity, expected.velocity, tolerance)
    for kind in ("apples", "bombs"):
        found, wanted = getattr(reached, kind), getattr(expected, kind)
        assert found.present.sum() == wanted.present.sum()
        for row in range(len(found.present)):
            left = np.asarray(found.position)[row, np.asarray(found.present)[row]]
            same(left, wanted.position[row, wanted.present[row]], tolerance)
    same(outcome.reward - outcome.danger, data["reward"], tolerance)
    np.testing.assert_array_equal(outcome.terminated, data["done"])
    assert not (outcome.truncated | outcome.goal).any()
    assert {0, 1, 2} == set(np.asarray(outcome.danger).tolist())

    observe = jax.jit(jax.vmap(point_gather.observe, (0, None)))
    for part, (state, suffix) in enumerate([(states, ""), (reached, "_next")]):
        observed, recorded = np.array(observe(state, params)), data[f"obs{suffix}"].copy()
        tied = tied_sensors(data, suffix, tie)
        assert tied.sum() == TIED_SENSORS[precision][part]
        observed[:, 9:][tied] = recorded[:, 9:][tied] = 0.0
        same(observed, recorded, tolerance)
