import enum

import jax
import numpy as np

from rp_jax.streams import Stream, key_of, numbered


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
