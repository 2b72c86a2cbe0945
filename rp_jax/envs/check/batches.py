"""Functions of one row, compiled for batches of rows that live on the host."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

BATCH = 256  # rows that are computed at a time
QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


class Batched:
    """A function of parameters and rows, compiled once: any number of rows is cut into batches.

    Rows and results are pytrees of NumPy arrays; random keys among them are held as their data.
    """

    def __init__(self, function: Callable[..., Any], whole: bool = False) -> None:
        """Prepares the function; it is compiled when it is first called.

        Args:
            function: takes the parameters and then one row of each pytree, unbatched.
            whole: the function takes whole batches (BATCH, ...) instead.
        """

        def run(params: Any, *rows: Any) -> Any:
            one = function if whole else _over_rows(function, len(rows))
            return frozen(one(params, *rows))

        quick = QUICK if jax.default_backend() == "cpu" else None  # compiled soon, run for a moment
        self._run = jax.jit(run, compiler_options=quick)

    def __call__(self, params: Any, *rows: Any) -> Any:
        """Returns the results of all rows, leading axis (n,).

        Args:
            params: given to each row.
            *rows: pytrees with leading axis (n,), n at least 1.
        """
        count = len(jax.tree.leaves(rows)[0])
        parts = [
            self._run(params, *jax.tree.map(lambda a, i=i: _batch(a, i), rows))
            for i in range(0, count, BATCH)
        ]
        parts = jax.device_get(parts)
        return jax.tree.map(lambda *part: np.concatenate(part)[:count], *parts)


def _over_rows(function: Callable[..., Any], count: int) -> Callable[..., Any]:
    return jax.vmap(function, (None, *[0] * count))


def _batch(rows: np.ndarray, start: int) -> np.ndarray:
    """Rows (BATCH, ...) from one on; the last row is repeated where there are no more."""
    part = rows[start : start + BATCH]
    spare = BATCH - len(part)
    return np.concatenate([part, np.repeat(part[-1:], spare, axis=0)]) if spare else part


def is_key(leaf: Any) -> bool:
    """Returns whether a leaf is a typed random key.

    Args:
        leaf: of a pytree.
    """
    return hasattr(leaf, "dtype") and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def typed(data: Any) -> jax.Array:
    """Returns random keys (...) from their data.

    Args:
        data: (..., n) words of the keys.
    """
    return jax.random.wrap_key_data(jnp.asarray(data))


def frozen(tree: Any) -> Any:
    """Returns a pytree in which typed random keys are replaced by their data.

    Args:
        tree: any pytree.
    """
    return jax.tree.map(lambda a: jax.random.key_data(a) if is_key(a) else a, tree)


def thawed(tree: Any, example: Any) -> Any:
    """Returns a pytree with the random keys that `frozen` has replaced.

    Args:
        tree: a result of `frozen`.
        example: a pytree alike, of arrays, with the keys; unbatched.
    """

    def thaw(leaf: Any, like: Any) -> Any:
        if not is_key(like):
            return leaf
        return jax.random.wrap_key_data(jnp.asarray(leaf), impl=jax.random.key_impl(like))

    return jax.tree.map(thaw, tree, example)


def take(tree: Any, index: Any) -> Any:
    """Returns rows of a pytree of NumPy arrays.

    Args:
        tree: leading axis (n,).
        index: which rows; whatever NumPy takes.
    """
    return jax.tree.map(lambda a: a[index], tree)


def join(*trees: Any) -> Any:
    """Returns pytrees of NumPy arrays one after another along the leading axis.

    Args:
        *trees: pytrees of the same structure.
    """
    return jax.tree.map(lambda *parts: np.concatenate(parts), *trees)


def repeat(tree: Any, times: int) -> Any:
    """Returns each row of a pytree of NumPy arrays so many times, one copy after another.

    Args:
        tree: leading axis (n,).
        times: how often.
    """
    return jax.tree.map(lambda a: np.repeat(a, times, axis=0), tree)


def flat(tree: Any) -> np.ndarray:
    """Returns the leaves of a pytree of NumPy arrays side by side, (n, D) floats.

    Args:
        tree: leading axis (n,).
    """
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    return np.concatenate([a.reshape(len(a), -1).astype(float) for a in leaves], axis=1)


class RandomDraws:
    """Random numbers on the host, from one key; each call gives other ones."""

    def __init__(self, key: Any) -> None:
        self._key, self._calls = key, 0
        self._block = 4096
        self._split = jax.jit(lambda key: jax.random.key_data(jax.random.split(key, self._block)))
        self._draw = jax.jit(lambda key: jax.random.uniform(key, (self._block,)))

    def _blocks(self, make: Callable[[Any], Any], count: int) -> np.ndarray:
        blocks = []
        for _ in range(-(-count // self._block)):
            self._calls += 1
            blocks.append(np.asarray(make(jax.random.fold_in(self._key, self._calls))))
        return np.concatenate(blocks)[:count]

    def keys(self, count: int) -> np.ndarray:
        """Returns the data of random keys (count, ...).

        Args:
            count: how many.
        """
        return self._blocks(self._split, count)

    def uniform(self, count: int) -> np.ndarray:
        """Returns numbers (count,) in [0, 1).

        Args:
            count: how many.
        """
        return self._blocks(self._draw, count).astype(float)

    def integers(self, count: int, most: int) -> np.ndarray:
        """Returns int32 numbers (count,) below `most`.

        Args:
            count: how many.
            most: all are less than this.
        """
        return np.minimum(self.uniform(count) * most, most - 1).astype(np.int32)

    def among(self, rows: Any, count: int) -> np.ndarray:
        """Returns so many of some indices (n,); each at most once, or all of them in turn.

        Args:
            rows: (n,) indices.
            count: how many.
        """
        rows = np.asarray(rows)
        if len(rows) > count:
            return rows[np.argsort(self.uniform(len(rows)))[:count]]
        return rows[np.arange(count) % len(rows)]
