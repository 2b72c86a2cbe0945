import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rp_jax.dynamics import angle_of, make_vehicle, rotate, squared_distance, to_body_frame

angles = st.floats(-np.pi, np.pi)
coordinates = st.floats(-5, 5)


def unit(angle):
    return jnp.stack([jnp.cos(jnp.asarray(angle)), jnp.sin(jnp.asarray(angle))], axis=-1)


@given(angles, angles, coordinates, coordinates)
def test_rotate_turns_to_the_left_and_to_ego_undoes_it(angle, direction, x, y):
    vector = jnp.asarray([x, y], float)
    turned = rotate(vector, unit(angle))
    expected = (x + 1j * y) * np.exp(1j * angle)
    np.testing.assert_allclose(turned, [expected.real, expected.imag], atol=1e-5)
    np.testing.assert_allclose(to_body_frame(turned, unit(angle)), vector, atol=1e-5)
    heading = unit(direction)
    np.testing.assert_allclose(to_body_frame(heading, heading), [1.0, 0.0], atol=1e-6)


def test_the_left_of_the_heading_is_the_positive_y_of_its_frame():
    np.testing.assert_allclose(
        to_body_frame(jnp.asarray([0.0, 1.0]), jnp.asarray([0.0, 1.0])), [1.0, 0.0], atol=1e-7
    )
    np.testing.assert_allclose(
        to_body_frame(jnp.asarray([-1.0, 0.0]), jnp.asarray([0.0, 1.0])), [0.0, 1.0], atol=1e-7
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
