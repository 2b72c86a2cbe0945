import jax.numpy as jnp
import numpy as np

from rp_jax.envs import contract, tally


def outcome(reward, danger, terminated, truncated, goal):
    flag = lambda values: jnp.asarray(values, bool)  # noqa: E731
    reward, danger = (jnp.asarray(values, jnp.float32) for values in (reward, danger))
    return contract.Outcome(reward, danger, flag(terminated), flag(truncated), flag(goal))


def test_a_tally_sums_what_ended_and_begins_anew():
    """A crash, the goal after danger, the end of time, and an episode that goes on."""
    running = tally.Running(jnp.asarray([1.0, 2, 3, 4]), jnp.asarray([0.0, 2, 0, 1]))
    step = outcome([10, 20, 30, 40], [1, 0, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0])
    running, ended = tally.tally(running, step)
    np.testing.assert_array_equal(running, [[0, 0, 0, 44], [0, 0, 0, 1]])
    assert ended == (3, 11 + 22 + 33, 1 + 2, 2, 1)
    counts = (ended.episodes, ended.crashes, ended.goals)
    assert {count.dtype for count in counts} == {np.dtype("int32")}


def test_counts_are_whole_numbers_in_double_precision_too(x64):
    assert tally.count(jnp.asarray([True, False, True])).dtype == jnp.int32
