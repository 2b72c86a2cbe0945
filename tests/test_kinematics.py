import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from rp_jax.envs import circuit, jam, point_gather
from rp_jax.kinematics import (
    Control,
    ControlDistribution,
    advance,
    angle_of,
    control_table,
    independent_controls,
    make_plans,
    make_vehicle,
    mirrored_actions,
    rotate,
    squared_distance,
    to_ego,
)

angles = st.floats(-np.pi, np.pi)
coordinates = st.floats(-5, 5)
SPEEDS = jnp.asarray([-0.04, -0.02, 0.0, 0.02, 0.04, 0.06, 0.08, 0.1])


def unit(angle):
    return jnp.stack([jnp.cos(jnp.asarray(angle)), jnp.sin(jnp.asarray(angle))], axis=-1)


def control(acceleration, turn):
    return Control(acceleration=jnp.asarray(acceleration, float), rotation=unit(float(turn)))


def test_a_step_moves_by_the_old_speed_along_the_old_heading():
    before = make_vehicle((1.0, 2.0), np.pi / 2, 0.06)
    after = advance(before, control(0.02, 0.15), SPEEDS)
    np.testing.assert_allclose(after.position, [1.0, 2.06], atol=1e-6)
    np.testing.assert_allclose(after.speed, 0.08, atol=1e-6)
    np.testing.assert_allclose(angle_of(after.heading), np.pi / 2 + 0.15, atol=1e-6)


@pytest.mark.parametrize(
    ("speed", "acceleration", "expected"),
    [(0.1, 0.02, 0.1), (0.09, 0.02, 0.1), (-0.04, -0.02, -0.04), (0.0, -0.02, -0.02)],
)
def test_speed_is_clipped_to_the_ends_of_the_reachable_speeds(speed, acceleration, expected):
    after = advance(make_vehicle((0.0, 0.0), 0.0, speed), control(acceleration, 0.0), SPEEDS)
    np.testing.assert_allclose(after.speed, expected, atol=1e-7)


def test_a_reversing_vehicle_moves_against_its_heading():
    after = advance(make_vehicle((0.0, 0.0), 0.0, -0.04), control(0.0, 0.1), SPEEDS)
    np.testing.assert_allclose(after.position, [-0.04, 0.0], atol=1e-7)
    np.testing.assert_allclose(angle_of(after.heading), 0.1, atol=1e-6)  # it still turns left


def test_the_heading_stays_a_unit_vector_over_a_thousand_turns():
    turn = control(0.0, 0.15)

    def step(vehicle, _):
        return advance(vehicle, turn, SPEEDS), None

    start = make_vehicle((0.0, 0.0), 0.3, 0.1)
    end = jax.jit(lambda v: jax.lax.scan(step, v, length=1000)[0])(start)
    np.testing.assert_allclose(jnp.linalg.norm(end.heading), 1.0, atol=1e-4)
    turned = np.angle(np.exp(1j * (0.3 + 1000 * 0.15)))
    np.testing.assert_allclose(angle_of(end.heading), turned, atol=1e-3)


def test_vehicles_step_in_batches_as_they_do_alone():
    vehicles = make_vehicle(np.arange(8.0).reshape(4, 2), np.arange(4.0), np.full(4, 0.02))
    controls = control_table((0.02,), (-0.1, 0.0, 0.1, 0.2))
    together = advance(vehicles, controls, SPEEDS)
    for row in range(4):
        pick = lambda tree, row=row: jax.tree.map(lambda a: a[row], tree)  # noqa: E731
        alone = advance(pick(vehicles), pick(controls), SPEEDS)
        jax.tree.map(np.testing.assert_array_equal, alone, pick(together))


@given(angles, angles, coordinates, coordinates)
def test_rotate_turns_to_the_left_and_to_ego_undoes_it(angle, direction, x, y):
    vector = jnp.asarray([x, y], float)
    turned = rotate(vector, unit(angle))
    expected = (x + 1j * y) * np.exp(1j * angle)
    np.testing.assert_allclose(turned, [expected.real, expected.imag], atol=1e-5)
    np.testing.assert_allclose(to_ego(turned, unit(angle)), vector, atol=1e-5)
    heading = unit(direction)
    np.testing.assert_allclose(to_ego(heading, heading), [1.0, 0.0], atol=1e-6)


def test_the_left_of_the_heading_is_the_positive_y_of_its_frame():
    np.testing.assert_allclose(
        to_ego(jnp.asarray([0.0, 1.0]), jnp.asarray([0.0, 1.0])), [1.0, 0.0], atol=1e-7
    )
    np.testing.assert_allclose(
        to_ego(jnp.asarray([-1.0, 0.0]), jnp.asarray([0.0, 1.0])), [0.0, 1.0], atol=1e-7
    )


@given(st.floats(-3.1, 3.1))
def test_angle_of_inverts_the_heading_of_a_vehicle(angle):
    vehicle = make_vehicle((0.0, 0.0), angle, 0.0)
    np.testing.assert_allclose(angle_of(vehicle.heading), angle, atol=1e-6)


def test_squared_distance_is_that_of_numpy():
    a, b = np.random.default_rng(0).normal(size=(2, 7, 2))
    expected = np.linalg.norm(a - b, axis=-1) ** 2
    actual = squared_distance(jnp.asarray(a, float), jnp.asarray(b, float))
    np.testing.assert_allclose(actual, expected, rtol=1e-5)


def test_a_table_of_controls_runs_over_turns_first():
    table = control_table((-0.02, 0.0, 0.02), (-0.3, -0.1, 0.0, 0.1, 0.3))
    assert table.acceleration.shape == (15,)
    assert table.rotation.shape == (15, 2)
    for i, acceleration in enumerate((-0.02, 0.0, 0.02)):
        for j, turn in enumerate((-0.3, -0.1, 0.0, 0.1, 0.3)):
            np.testing.assert_allclose(table.acceleration[5 * i + j], acceleration, atol=1e-7)
            np.testing.assert_allclose(angle_of(table.rotation[5 * i + j]), turn, atol=1e-6)


def test_mirrored_actions_keep_the_acceleration_and_swap_the_turn():
    mirror = mirrored_actions(control_table((-0.02, 0.0, 0.02), (-0.3, -0.1, 0.0, 0.1, 0.3)))
    np.testing.assert_array_equal(mirror, [4, 3, 2, 1, 0, 9, 8, 7, 6, 5, 14, 13, 12, 11, 10])


def test_mirrored_actions_are_refused_where_an_action_has_no_mirror_image():
    with pytest.raises(ValueError, match=r"actions.*mirror"):
        mirrored_actions(control_table((0.0,), (-0.3, 0.0, 0.1)))


def test_independent_controls_have_the_product_of_both_probabilities():
    law = independent_controls((-1.0, 1.0), (0.3, 0.7), (-0.1, 0.0, 0.1), (0.2, 0.5, 0.3))
    expected = [0.06, 0.15, 0.09, 0.14, 0.35, 0.21]
    np.testing.assert_allclose(law.probabilities, expected, atol=1e-7)
    np.testing.assert_allclose(law.controls.acceleration, [-1, -1, -1, 1, 1, 1])


def test_controls_are_drawn_with_their_probabilities():
    law = independent_controls((-1.0, 1.0), (0.3, 0.7), (-0.1, 0.0, 0.1), (0.2, 0.5, 0.3))
    drawn = law.sample(jax.random.key(0), (200, 300))
    assert drawn.acceleration.shape == (200, 300)
    assert drawn.rotation.shape == (200, 300, 2)
    kind = 3 * (np.asarray(drawn.acceleration) > 0) + np.digitize(
        np.asarray(angle_of(drawn.rotation)), (-0.05, 0.05)
    )
    counts = np.bincount(kind.reshape(-1), minlength=6)
    expected = np.asarray(law.probabilities, np.float64)
    assert stats.chisquare(counts, expected / expected.sum() * counts.sum()).pvalue > 1e-4


def test_a_single_control_is_drawn_without_a_shape():
    law = independent_controls((-1.0, 1.0), (0.3, 0.7), (0.0,), (1.0,))
    drawn = law.sample(jax.random.key(0))
    assert drawn.acceleration.shape == ()
    assert drawn.rotation.shape == (2,)


def test_controls_without_probability_are_never_drawn():
    law = ControlDistribution(
        controls=control_table((0.0, 1.0, 2.0, 3.0), (0.0,)),
        probabilities=jnp.asarray([0.0, 0.5, 0.5, 0.0]),
    )
    drawn = np.asarray(law.sample(jax.random.key(1), (20000,)).acceleration)
    assert set(drawn) == {1.0, 2.0}


def test_more_draws_from_a_key_begin_with_the_fewer():
    law = independent_controls((-1.0, 1.0), (0.3, 0.7), (-0.1, 0.1), (0.5, 0.5))
    key = jax.random.key(2)
    few, many = law.sample(key, (3,)), law.sample(key, (15,))
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[:3]), few, many)


PLANS = make_plans((-0.3, 0.0, 0.3), (0.1, -0.1), 3, 0.02, 0.1)


def one_plan(k):
    fields = {name: getattr(PLANS, name)[k] for name in ("rotation", "target", "steps")}
    return PLANS.replace(**fields)


def test_plans_are_all_turns_at_all_targets_braking_first():
    np.testing.assert_allclose(PLANS.target, np.repeat([0, 0.1, -0.1], 3), atol=1e-7)
    np.testing.assert_array_equal(PLANS.steps, np.repeat([0, 3, 3], 3))
    np.testing.assert_allclose(angle_of(PLANS.rotation), np.tile([-0.3, 0, 0.3], 3), atol=1e-6)
    assert PLANS.horizon == 1 + 3 + 5 + 1


@pytest.mark.parametrize("task", [circuit, jam, point_gather])
def test_a_continuous_action_says_what_the_table_says_at_its_rows(task):
    agent = task.make_params().agent
    strongest = max(task.ACCELERATIONS), max(task.TURNS)
    pairs = itertools.product(task.ACCELERATIONS, task.TURNS)
    for action, (acceleration, turn) in enumerate(pairs):
        row = agent.control(jnp.asarray(action))
        share = jnp.asarray([acceleration / strongest[0], turn / strongest[1]])
        np.testing.assert_allclose(agent.shares[action], share, atol=1e-6)
        for scale in (1.0, 4.0) if abs(share).min() == 1 else (1.0,):  # greater ones are cut
            found = agent.control(scale * share)
            np.testing.assert_allclose(found.acceleration, row.acceleration, atol=1e-7)
            np.testing.assert_allclose(found.rotation, row.rotation, atol=1e-6)


@pytest.mark.parametrize("k", range(9))
@pytest.mark.parametrize("speed", [-0.1, -0.06, 0.0, 0.02, 0.1])
def test_every_plan_goes_to_its_target_and_then_to_a_halt(k, speed):
    plan, speeds = one_plan(k), []
    for j in range(PLANS.horizon - 1):
        control = plan.control(j, jnp.asarray(speed))
        assert abs(float(control.acceleration)) <= 0.02 + 1e-7
        speed = speed + float(control.acceleration)
        speeds.append(speed)
    assert abs(speeds[-1]) < 1e-6
    if k >= 3 and float(plan.target) * speeds[0] > 0:
        assert abs(speeds[2]) >= abs(speeds[0]) - 1e-6


@pytest.mark.parametrize("baseline", ["paper", "plans"])
def test_mirrored_threats_swap_the_turns_of_plan_and_action(baseline):
    agent = jam.make_params(1, baseline=baseline).agent
    order = agent.mirrored_threats()
    assert len(order) == agent.num_threats == (15 if baseline == "paper" else 135)
    np.testing.assert_array_equal(order[order], np.arange(len(order)))
    if baseline == "plans":
        # Braking to the right after the hardest turn left is mirrored by the opposite.
        assert order[0 * 15 + 4] == 2 * 15 + 0
        assert order[1 * 15 + 7] == 1 * 15 + 7  # straight on is its own image


def test_mirrored_threats_are_refused_where_a_plan_has_no_mirror_image():
    agent = jam.make_params(1, baseline="plans").agent
    lopsided = make_plans((0.0, 0.3), (), 0, 0.02, 0.1)
    with pytest.raises(ValueError, match="baseline: there is no mirror image"):
        agent.replace(baseline=lopsided).mirrored_threats()


def test_a_point_changes_first_then_moves_and_stands_still_again():
    control = Control(acceleration=jnp.asarray(0.5), rotation=jnp.asarray([0.0, 1.0]))
    vehicle = make_vehicle((1.0, 2.0), 0.0, 0.0)
    speeds = jnp.asarray([-1.0, 1.0])
    point = advance(vehicle, control, speeds, delayed=False)
    np.testing.assert_allclose(point.position, [1.0, 2.5], atol=1e-6)
    np.testing.assert_allclose(point.heading, [0.0, 1.0], atol=1e-6)
    assert point.speed == 0
    car = advance(vehicle, control, speeds)
    np.testing.assert_allclose(car.position, [1.0, 2.0])
    assert car.speed == 0.5
    strongest = control.replace(acceleration=jnp.asarray(3.0))
    np.testing.assert_allclose(advance(vehicle, strongest, speeds, False).position, [1.0, 3.0])


def test_a_room_holds_its_agent_and_no_other():
    agent = point_gather.make_params().agent
    control = Control(acceleration=jnp.asarray(1.0), rotation=jnp.asarray([1.0, 0.0]))
    vehicle = make_vehicle((5.5, -5.9), -np.pi / 4, 0.0)
    np.testing.assert_allclose(agent.step(vehicle, control).position, [6.0, -6.0])
    free = agent.replace(room=None).step(vehicle, control)
    assert free.position[0] > 6 > -6 > free.position[1]
