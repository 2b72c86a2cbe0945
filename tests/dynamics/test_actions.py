import numpy as np
import pytest

from rp_jax.dynamics import angle_of, control_table, mirrored_actions


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
