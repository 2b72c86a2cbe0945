import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax.planning.nstep import WindowStep, n_step_transition
from rp_jax.planning.percept import Encoded

GAMMA = 0.9


def window(rewards, terminated, done):
    """Steps from state i to state i + 1, which 10 + i and a mask of action i alone name."""
    n = len(rewards)
    seen = lambda names: Encoded(jnp.zeros((n, 1), jnp.uint8), names[:, None])  # noqa: E731
    count = jnp.arange(n, dtype=jnp.float32)
    return WindowStep(
        encoded=seen(count),
        action=jnp.arange(n, dtype=jnp.int32) + 5,
        reward=jnp.asarray(rewards, jnp.float32),
        terminated=jnp.asarray(terminated, bool),
        done=jnp.asarray(done, bool),
        next_encoded=seen(10 + count),
        next_admissible=jnp.eye(n, dtype=bool),
    )


CASES = {
    # name: (terminated, done, steps counted, discount)
    "no end": ([0, 0, 0], [0, 0, 0], 3, GAMMA**3),
    "truncated at the last step": ([0, 0, 0], [0, 0, 1], 3, GAMMA**3),
    "truncated in between": ([0, 0, 0], [0, 1, 0], 2, GAMMA**2),
    "truncated at once": ([0, 0, 0], [1, 0, 0], 1, GAMMA),
    "terminated at the last step": ([0, 0, 1], [0, 0, 1], 3, 0),
    "terminated in between": ([0, 1, 0], [0, 1, 0], 2, 0),
    "terminated at once": ([1, 0, 0], [1, 0, 0], 1, 0),
    "terminated, and the next episode too": ([1, 0, 1], [1, 0, 1], 1, 0),
    "truncated, then the next one terminated": ([0, 1, 0], [1, 1, 0], 1, GAMMA),
    "terminated, then the next one truncated": ([1, 0, 0], [1, 1, 0], 1, 0),
}


@pytest.mark.parametrize("case", CASES)
def test_it_reaches_to_the_first_end_and_only_a_true_end_cuts_the_future(case):
    terminated, done, counted, discount = CASES[case]
    rewards = [1.0, 20.0, 300.0]
    found = n_step_transition(window(rewards, terminated, done), GAMMA)
    expected = sum(GAMMA**k * rewards[k] for k in range(counted))
    assert found.reward == pytest.approx(expected, rel=1e-6)
    assert found.discount == pytest.approx(discount, rel=1e-6)
    assert found.encoded.rest.item() == 0
    assert found.action == 5
    assert found.next_encoded.rest.item() == 10 + counted - 1
    np.testing.assert_array_equal(found.next_admissible, np.arange(3) == counted - 1)


@pytest.mark.parametrize(("terminated", "discount"), [(False, GAMMA), (True, 0.0)])
def test_one_step_is_the_transition_itself(terminated, discount):
    found = n_step_transition(window([7.0], [terminated], [terminated]), GAMMA)
    assert found.reward == 7
    assert found.discount == pytest.approx(discount)
    assert found.next_encoded.rest.item() == 10


def test_rewards_of_the_next_episode_do_not_count():
    one = n_step_transition(window([1.0, 2.0, 1e9], [0, 0, 0], [0, 1, 0]), GAMMA)
    two = n_step_transition(window([1.0, 2.0, np.nan], [0, 0, 0], [0, 1, 0]), GAMMA)
    assert one.reward == two.reward == pytest.approx(1 + GAMMA * 2)


def test_future_rewards_count_less_step_by_step():
    found = n_step_transition(window([1.0] * 20, [0] * 20, [0] * 20), GAMMA)
    assert found.reward == pytest.approx((1 - GAMMA**20) / (1 - GAMMA), rel=1e-5)
    assert found.discount == pytest.approx(GAMMA**20, rel=1e-5)
