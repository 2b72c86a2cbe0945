import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from quick import compile_soon  # noqa: F401

from rp_jax import arrays


def same_bits(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


@given(hnp.arrays(bool, 13), st.sampled_from([1, 4, 40]))
def test_renew_makes_exactly_the_marked_rows(where, chunk):
    rows = {"a": jnp.arange(13.0), "b": jnp.arange(26).reshape(13, 2)}
    renewed = replace_rows(jnp.asarray(where), rows, chunk)
    new = make(jnp.arange(13))
    expected = {
        "a": jnp.where(where, new["a"], rows["a"]),
        "b": jnp.where(where[:, None], new["b"], rows["b"]),
    }
    same_bits(renewed, expected)


def make(indices):
    return {"a": 100.0 + indices, "b": jnp.stack([-indices, indices * indices], axis=-1)}


@functools.partial(jax.jit, static_argnums=2)
def replace_rows(where, rows, chunk):
    return arrays.replace_rows(where, rows, make, chunk)


@pytest.mark.parametrize("marked", [[], [12], [1, 5, 7, 8, 12], list(range(13))])
@pytest.mark.parametrize("chunk", [4, 16])
def test_renew_computes_no_row_that_is_not_marked(marked, chunk):
    asked = []

    def recorded(indices):
        asked.append(np.asarray(indices).tolist())
        return make(indices)

    where = jnp.asarray([i in marked for i in range(13)])
    rows = {"a": jnp.arange(13.0), "b": jnp.arange(26).reshape(13, 2)}
    with jax.disable_jit():  # so that the loop runs in Python, and calls are seen
        arrays.replace_rows(where, rows, recorded, chunk)
    assert len(asked) == -(-len(marked) // chunk)
    assert all(len(indices) == chunk for indices in asked)
    assert sorted(i for indices in asked for i in indices if i < 13) == marked


def test_renew_keeps_the_rows_of_any_pytree_with_typed_keys():
    keys = jax.random.split(jax.random.key(0), 5)
    others = jax.random.split(jax.random.key(1), 5)
    where = jnp.asarray([True, False, False, True, False])
    renewed = arrays.replace_rows(where, (keys,), lambda i: (others.at[i].get(mode="clip"),), 2)
    expected = np.where(where[:, None], jax.random.key_data(others), jax.random.key_data(keys))
    np.testing.assert_array_equal(jax.random.key_data(renewed[0]), expected)


def test_select_chooses_whole_pytrees():
    yes, no = {"a": jnp.ones(3), "b": jnp.asarray(1)}, {"a": jnp.zeros(3), "b": jnp.asarray(0)}
    same_bits(arrays.select(jnp.asarray(True), yes, no), yes)
    same_bits(arrays.select(jnp.asarray(False), yes, no), no)


@pytest.mark.parametrize(
    ("values", "expected"),
    [([], []), ([3.0], [0]), ([0.2, 0.1, 0.3], [1, 0, 2]), ([2.0, 1.0, 2.0, 1.0], [2, 0, 3, 1])],
)
def test_ranks_count_what_stands_before_and_leave_equals_as_they_come(values, expected):
    np.testing.assert_array_equal(arrays.ranks(jnp.asarray(values, float)), expected)


@given(hnp.arrays(np.float32, st.integers(1, 9), elements=st.integers(-3, 3)))
def test_ranks_put_values_in_ascending_order(values):
    rank = np.asarray(arrays.ranks(jnp.asarray(values)))
    np.testing.assert_array_equal(rank, np.argsort(np.argsort(values, kind="stable")))


@given(hnp.arrays(np.float32, st.sampled_from([9, 40]), elements=st.integers(-3, 3)))
def test_smallest_values_come_first_and_equals_as_they_stand(values):
    found = np.asarray(arrays.smallest(jnp.asarray(values), 4))
    np.testing.assert_array_equal(found, np.argsort(values, kind="stable")[:4])


@pytest.mark.parametrize(
    ("where", "chunk", "indices", "count"),
    [
        ([0, 1, 0, 1, 1], 1, [1, 3, 4, 9, 9], 3),
        ([0, 1, 0, 1, 1], 4, [1, 3, 4, 9, 9, 9, 9, 9], 3),
        ([0, 0], 2, [9, 9], 0),
        ([1, 1, 1], 3, [0, 1, 2], 3),
    ],
)
def test_compact_indices_are_the_marked_places_and_then_the_spare_one(where, chunk, indices, count):
    found, marked = arrays.compact_indices(jnp.asarray(where, bool), chunk, 9)
    np.testing.assert_array_equal(found, indices)
    assert marked == count
    assert found.dtype == marked.dtype == jnp.int32
