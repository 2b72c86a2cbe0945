import jax
import jax.numpy as jnp
import numpy as np
from quick import compile_soon  # noqa: F401

from rp_jax.envs import autoreset, contract


def same_bits(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


class Toy:
    """Counts to `state["last"]`, which every start draws anew."""

    @staticmethod
    def reset(key, params):
        last = jax.random.randint(key, (), 1, params)
        return {"last": last, "time": jnp.asarray(0, jnp.int32)}

    @staticmethod
    def step(key, state, action, params):
        time = state["time"] + 1
        no = jnp.asarray(False)
        ended = time >= state["last"]
        outcome = contract.Outcome(
            reward=action + 0.0, danger=jnp.zeros(()), terminated=ended, truncated=no, goal=no
        )
        return {"last": state["last"], "time": time}, outcome


class Keys:
    """Its states hold the words of the keys that they were made with; ends are by a table."""

    @staticmethod
    def reset(key, params):
        return {"made_by": jax.random.key_data(key), "row": jnp.asarray(-1)}

    @staticmethod
    def step(key, state, action, params):
        terminated, truncated = params[state["row"]]
        none = jnp.zeros(())
        outcome = contract.Outcome(none, none, terminated, truncated, jnp.asarray(False))
        return {"made_by": jax.random.key_data(key), "row": state["row"]}, outcome


def test_either_end_restarts_an_episode_with_a_key_that_no_step_has():
    ends = jnp.asarray([[False, False], [True, False], [False, True]])
    keys = jax.random.split(jax.random.key(0), 3)
    states = {"made_by": jnp.zeros((3, 2), jnp.uint32), "row": jnp.arange(3)}
    carried, reached, outcome = jax.jit(autoreset.auto_reset_step, static_argnums=0)(
        Keys, keys, states, jnp.zeros(3, int), ends
    )
    np.testing.assert_array_equal(outcome.done, [False, True, True])
    np.testing.assert_array_equal(reached["row"], [0, 1, 2])
    np.testing.assert_array_equal(carried["row"], [0, -1, -1])
    words = np.concatenate([carried["made_by"], reached["made_by"]])
    assert len(np.unique(words, axis=0)) == 3 + 2  # the row that goes on is in both


def test_what_is_seen_belongs_to_the_states_and_starts_are_looked_at_only_where_needed():
    keys = jax.random.split(jax.random.key(0), 40)
    last = jnp.arange(40, dtype=jnp.int32) % 4 + 1
    states = {"last": last, "time": jnp.ones(40, jnp.int32)}
    looked = []

    def look(states):
        looked.append(len(states["time"]))
        return 1000 * states["last"] + states["time"]

    @jax.jit
    def advance(keys, states):
        args = Toy, keys, states, jnp.zeros(40, int), 1000
        return autoreset.step_and_renew(*args, look), autoreset.auto_reset_step(*args)

    (carried, reached, outcome), unseen = advance(keys, states)
    same_bits(unseen, (carried[0], reached[0], outcome))
    np.testing.assert_array_equal(outcome.done, last <= 2)
    assert set(looked) == {40, 16}  # at all that were reached, and at starts by the chunk
    np.testing.assert_array_equal(reached[0]["time"], np.full(40, 2))
    np.testing.assert_array_equal(reached[0]["last"], last)
    np.testing.assert_array_equal(carried[0]["time"], np.where(outcome.done, 0, 2))
    fresh = carried[0]["last"][outcome.done]
    assert len(np.unique(fresh)) > 15
    for states, seen in (carried, reached):
        np.testing.assert_array_equal(seen, 1000 * states["last"] + states["time"])
