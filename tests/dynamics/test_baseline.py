import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rp_jax.dynamics import (
    ControlDistribution,
    angle_of,
    control_table,
    independent_controls,
    make_plans,
)


def test_independent_controls_have_the_product_of_both_probabilities():
    law = independent_controls((-1.0, 1.0), (0.3, 0.7), (-0.1, 0.0, 0.1), (0.2, 0.5, 0.3))
    expected = [0.06, 0.15, 0.09, 0.14, 0.35, 0.21]
    np.testing.assert_allclose(law.probabilities, expected, atol=1e-7)
    np.testing.assert_allclose(law.controls.acceleration, [-1, -1, -1, 1, 1, 1])


def test_controls_are_drawn_with_their_probabilities():
    law = independent_controls((-1.0, 1.0), (0.3, 0.7), (-0.1, 0.0, 0.1), (0.2, 0.5, 0.3))
    drawn = law.draw(jax.random.key(0), (200, 300))
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
    drawn = law.draw(jax.random.key(0))
    assert drawn.acceleration.shape == ()
    assert drawn.rotation.shape == (2,)


def test_controls_without_probability_are_never_drawn():
    law = ControlDistribution(
        controls=control_table((0.0, 1.0, 2.0, 3.0), (0.0,)),
        probabilities=jnp.asarray([0.0, 0.5, 0.5, 0.0]),
    )
    drawn = np.asarray(law.draw(jax.random.key(1), (20000,)).acceleration)
    assert set(drawn) == {1.0, 2.0}


def test_more_draws_from_a_key_begin_with_the_fewer():
    law = independent_controls((-1.0, 1.0), (0.3, 0.7), (-0.1, 0.1), (0.5, 0.5))
    key = jax.random.key(2)
    few, many = law.draw(key, (3,)), law.draw(key, (15,))
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


def test_a_distribution_acts_as_drawn_whatever_the_body_does():
    law = independent_controls((-0.2, 0.1), (0.3, 0.7), (-0.3, 0.0), (0.5, 0.5))
    drawn = law.draw(jax.random.key(3))
    assert law.act("any body", drawn) is drawn
    np.testing.assert_allclose(law.max_acceleration, 0.2, atol=1e-7)
    np.testing.assert_allclose(angle_of(law.rotations), [-0.3, 0.0, -0.3, 0.0], atol=1e-6)
