import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax.dynamics import Control, advance, angle_of, control_table, make_vehicle

SPEEDS = jnp.asarray([-0.04, -0.02, 0.0, 0.02, 0.04, 0.06, 0.08, 0.1])


def control(acceleration, turn):
    rotation = jnp.asarray([np.cos(turn), np.sin(turn)], float)
    return Control(acceleration=jnp.asarray(acceleration, float), rotation=rotation)


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
    too_strong = control.replace(acceleration=jnp.asarray(3.0))
    np.testing.assert_allclose(advance(vehicle, too_strong, speeds, False).position, [1.0, 3.0])
