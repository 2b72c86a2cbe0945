import enum

import jax
import numpy as np

from rp_jax.streams import Stream, key_of, key_of_state, numbered


def words(keys):
    return [tuple(row) for row in np.asarray(jax.random.key_data(keys)).reshape(-1, 2).tolist()]


def test_each_use_has_a_number_of_its_own():
    enum.verify(enum.UNIQUE)(Stream)


def test_no_two_uses_of_keys_share_a_key():
    keys = [jax.random.key(seed) for seed in range(10)]
    own = [word for key in keys for stream in Stream for word in words(key_of(key, stream))]
    learned = words(numbered(key_of(keys[0], Stream.PLANNING), list(range(100))))
    judged = words(numbered(key_of(keys[0], Stream.EVALUATION), list(range(100))))
    assert len({*own, *learned, *judged}) == len(own) + 200


def test_the_key_of_a_number_does_not_depend_on_the_others():
    key = jax.random.key(3)
    assert words(numbered(key, [4, 7, 1]))[1] == words(numbered(key, [7]))[0]


def test_keys_of_states_differ_wherever_states_do():
    """By one bit of any array, by the use, and from the keys of any seed."""
    state = {"at": np.zeros((50, 2), np.float32), "time": np.arange(50, dtype=np.int32)}
    state["flag"] = np.zeros(50, bool)
    state["key"] = jax.random.split(jax.random.key(1), 50)
    near = {**state, "at": np.nextafter(state["at"], np.float32(1))}
    flagged = {**state, "flag": ~state["flag"]}
    of = jax.jit(jax.vmap(key_of_state, (0, None)), static_argnums=1)
    seen = [
        word
        for states in (state, near, flagged)
        for stream in (Stream.LOOKAHEAD, Stream.ACCOUNT)
        for word in words(of(states, stream))
    ]
    keys = jax.vmap(jax.random.key)(np.arange(5000))
    own = words(jax.vmap(key_of, (0, None))(keys, Stream.LOOKAHEAD))
    assert len({*seen, *own}) == 6 * 50 + len(own)
    assert words(of(state, Stream.LOOKAHEAD)) == seen[:50]  # equal states, equal keys
