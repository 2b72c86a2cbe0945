import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax.dynamics import Control, make_plans, make_vehicle, num_threats
from rp_jax.envs import circuit, jam, point_gather


@pytest.mark.parametrize("task", [circuit, jam, point_gather])
def test_a_continuous_action_says_what_the_table_says_at_its_rows(task):
    body = task.make_params().body
    most = max(task.ACCELERATIONS), max(task.TURNS)
    pairs = itertools.product(task.ACCELERATIONS, task.TURNS)
    for action, (acceleration, turn) in enumerate(pairs):
        row = body.control(jnp.asarray(action))
        share = jnp.asarray([acceleration / most[0], turn / most[1]])
        np.testing.assert_allclose(body.normalized_actions[action], share, atol=1e-6)
        for scale in (1.0, 4.0) if abs(share).min() == 1 else (1.0,):  # greater ones are cut
            found = body.control(scale * share)
            np.testing.assert_allclose(found.acceleration, row.acceleration, atol=1e-7)
            np.testing.assert_allclose(found.rotation, row.rotation, atol=1e-6)


@pytest.mark.parametrize("baseline", ["paper", "plans"])
def test_mirrored_threats_swap_the_turns_of_plan_and_action(baseline):
    body = jam.make_params(1, baseline=baseline).body
    order = body.mirrored_threats()
    assert len(order) == num_threats(body) == (15 if baseline == "paper" else 135)
    np.testing.assert_array_equal(order[order], np.arange(len(order)))
    if baseline == "plans":
        # Braking to the right after the hardest turn left is mirrored by the opposite.
        assert order[0 * 15 + 4] == 2 * 15 + 0
        assert order[1 * 15 + 7] == 1 * 15 + 7  # straight on is its own image


def test_mirrored_threats_are_refused_where_a_plan_has_no_mirror_image():
    body = jam.make_params(1, baseline="plans").body
    lopsided = make_plans((0.0, 0.3), (), 0, 0.02, 0.1)
    with pytest.raises(ValueError, match="baseline: there is no mirror image"):
        body.replace(baseline=lopsided).mirrored_threats()


def test_a_room_holds_its_body_and_no_other():
    body = point_gather.make_params().body
    control = Control(acceleration=jnp.asarray(1.0), rotation=jnp.asarray([1.0, 0.0]))
    vehicle = make_vehicle((5.5, -5.9), -np.pi / 4, 0.0)
    np.testing.assert_allclose(body.step(vehicle, control).position, [6.0, -6.0])
    free = body.replace(room=None).step(vehicle, control)
    assert free.position[0] > 6 > -6 > free.position[1]
