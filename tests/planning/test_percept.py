import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax.planning.percept import Encoded, encode, non_finite, not_finite


def test_bins_where_nothing_is_seen_are_the_farthest():
    observation = jnp.asarray([0.0, 0.5, 1.0, 0.2, 3.0, -4.0])
    encoded = encode(observation, 4, 1)
    assert encoded.scan.dtype == jnp.uint8
    assert encoded.scan.tolist() == [255, 128, 255, 51]  # 127.5 rounds to even
    np.testing.assert_array_equal(encoded.rest, [3.0, -4.0])


def test_pooling_keeps_the_nearest_of_its_neighbours():
    scan = [0.0, 0.9, 0.4, 0.0, 0.0, 0.0, 0.1, 1.0]
    encoded = encode(jnp.asarray([*scan, 7.0]), 8, 2)
    assert encoded.scan.tolist() == [230, 102, 255, 26]
    assert encode(jnp.asarray([*scan, 7.0]), 8, 4).scan.tolist() == [102, 26]
    assert encode(jnp.asarray([*scan, 7.0]), 8, 8).scan.tolist() == [26]


def test_pooling_never_hides_what_is_nearer():
    rng = np.random.default_rng(0)
    scan = np.where(rng.random((50, 360)) < 0.4, 0.0, rng.uniform(0.01, 1, (50, 360)))
    rest = np.zeros((50, 2))
    observations = jnp.asarray(np.concatenate([scan, rest], axis=-1), jnp.float32)
    one, eight = (jax.vmap(encode, (0, None, None))(observations, 360, p).scan for p in (1, 8))
    np.testing.assert_array_equal(eight, np.asarray(one).reshape(50, 45, 8).min(axis=-1))


def test_bytes_that_hide_a_number_that_is_none_make_the_rest_none():
    observation = jnp.asarray([0.3, jnp.nan, 7.0, 8.0])
    assert jnp.isnan(encode(observation, 2, 2).rest).all()
    np.testing.assert_array_equal(encode(observation, 0, 8).rest[2:], [7, 8])  # no LIDAR at all


@pytest.mark.parametrize("none", [jnp.nan, jnp.inf, -jnp.inf])
def test_faults_are_told_row_by_row_and_apart(none):
    encoded = Encoded(jnp.zeros((3, 2), jnp.uint8), jnp.zeros((3, 2)).at[0, 1].set(none))
    threat = jnp.zeros((3, 4)).at[2, 3].set(none)
    observations, threats = jax.jit(non_finite)(encoded, threat)
    np.testing.assert_array_equal(observations, [True, False, False])
    np.testing.assert_array_equal(threats, [False, False, True])
    np.testing.assert_array_equal(not_finite(threat), threats)
