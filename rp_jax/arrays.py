"""Functions on arrays and pytrees that JAX lacks."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

SHORT = 32  # longest list that is ranked by counting


def select(condition: Array, yes: Any, no: Any) -> Any:
    """Returns one of two pytrees, as `jnp.where` does for arrays.

    Args:
        condition: () bool.
        yes: the pytree to return where the condition holds.
        no: the pytree to return elsewhere; same structure and shapes as `yes`.
    """
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def zeros_like(shape: jax.ShapeDtypeStruct | Array) -> Array:
    """Returns zeros of a shape and type; keys are that of seed 0.

    Args:
        shape: an array, or its shape and type.
    """
    if jax.dtypes.issubdtype(shape.dtype, jax.dtypes.prng_key):
        return jnp.broadcast_to(jax.random.key(0), shape.shape)
    return jnp.zeros(shape.shape, shape.dtype)


def ranks(values: Array) -> Array:
    """Returns each value's place in ascending order.

    Counting is faster than a sort for short lists.

    Args:
        values: (n,) numbers.

    Returns:
        (n,) int, how many values come before each one; equal values keep their order.
    """
    count = jnp.arange(len(values))
    ahead = (values[None, :] < values[:, None]) | (
        (values[None, :] == values[:, None]) & (count[None, :] < count[:, None])
    )
    return jnp.sum(ahead, axis=-1)


def smallest(values: Array, count: int) -> Array:
    """Returns where the smallest values are, in ascending order.

    Counting, and for long lists a few minima one after another, are faster than a sort.

    Args:
        values: (n,) numbers below the greatest of their type.
        count: how many are wanted, at most n.

    Returns:
        (count,) int32 indices; of equal values the first comes first.
    """
    index = jnp.arange(len(values), dtype=jnp.int32)
    if len(values) <= SHORT:
        return jnp.zeros(count, jnp.int32).at[ranks(values)].set(index, mode="drop")

    def take(left: Array, _: None) -> tuple[Array, Array]:
        # Two minima instead of an argmin, since they vectorise.
        least = jnp.min(jnp.where(left == jnp.min(left), index, len(values)))
        return jnp.where(index == least, jnp.finfo(left.dtype).max, left), least

    return jax.lax.scan(take, values, length=count)[1]


def compact_indices(where: Array, chunk: int, spare: int) -> tuple[Array, Array]:
    """Returns the indices of the marked places in ascending order, padded to a fixed length.

    Args:
        where: (n,) bool, the marked places.
        chunk: the length m of the result is n rounded up to a multiple of this.
        spare: number that fills the rest of the result.

    Returns:
        The indices (m,) int32, and how many of them are marked places, () int32.
    """
    count = where.shape[0]
    size = -(-count // chunk) * chunk
    rank = jnp.cumsum(where.astype(jnp.int32))
    slot = jnp.where(where, rank - 1, size)
    order = jnp.full(size, spare, jnp.int32)
    order = order.at[slot].set(jnp.arange(count, dtype=jnp.int32), mode="drop")
    return order, rank[-1]


def replace_rows(where: Array, rows: Any, make: Callable[[Array], Any], chunk: int = 16) -> Any:
    """Replaces the marked rows of a batch, and computes only those.

    Args:
        where: (B,) bool, the rows to replace.
        rows: pytree with leading axis (B,).
        make: maps indices (chunk,) to new rows with leading axis (chunk,). It is called until all
            marked rows are made; an index of B fills places that are left over.
        chunk: number of rows made at a time.

    Returns:
        `rows` with the marked rows replaced.
    """
    order, count = compact_indices(where, chunk, where.shape[0])

    def some(carry):
        start, rows = carry
        indices = jax.lax.dynamic_slice(order, (start,), (chunk,))
        new = make(indices)
        rows = jax.tree.map(lambda old, now: old.at[indices].set(now, mode="drop"), rows, new)
        return start + chunk, rows

    return jax.lax.while_loop(lambda c: c[0] < count, some, (0, rows))[1]
