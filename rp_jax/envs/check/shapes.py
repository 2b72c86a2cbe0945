"""Shapes of what functions return, without computing anything."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rp_jax.envs.check.problems import described, trouble


def shape_of(what: str, function: Callable[..., Any], *args: Any) -> tuple[Any, list[str]]:
    """Traces a function and returns the shapes of its result, and what goes wrong.

    Args:
        what: the function, for the sentence.
        function: the function.
        *args: its arguments, arrays or their shapes.

    Returns:
        (pytree of shapes, problems); the shapes are None if it cannot be traced.
    """
    try:
        return jax.eval_shape(function, *args), []
    except Exception as error:
        return None, [f"{what} cannot be traced by jax.eval_shape: {trouble(error)}"]


def scalar(what: str, leaf: Any, kind: str) -> list[str]:
    """Returns a sentence unless a value is a () array of a kind: "bool", "integer" or "floating".

    Args:
        what: the value, for the sentence.
        leaf: the value or its shape.
        kind: what it must be.
    """
    dtypes = {"bool": jnp.bool_, "integer": jnp.integer, "floating": jnp.floating}
    good = hasattr(leaf, "dtype") and hasattr(leaf, "shape") and leaf.shape == ()
    if good and jnp.issubdtype(leaf.dtype, dtypes[kind]):
        return []
    return [f"{what} is {described(leaf)}; it must be () {kind}"]


def missing_methods(owner: Any, name: str, methods: dict[str, str]) -> list[str]:
    """Returns a sentence for each method that an object lacks.

    Args:
        owner: the object.
        name: what it is, for the sentence.
        methods: the arguments of each method, by the method's name.
    """
    return [
        f"{name} has no method `{method}`; it must have {method}{arguments}"
        for method, arguments in methods.items()
        if not callable(getattr(owner, method, None))
    ]


def with_leading(shape: tuple[int, ...], tree: Any) -> Any:
    """Returns the shapes of a pytree with further leading axes.

    Args:
        shape: the leading axes.
        tree: pytree of shapes.
    """
    return jax.tree.map(lambda a: jax.ShapeDtypeStruct((*shape, *a.shape), a.dtype), tree)


def first_row(tree: Any) -> Any:
    """Returns the shapes of a pytree without the leading axis.

    Args:
        tree: of shapes, leading axis (n,).
    """
    return jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape[1:], a.dtype), tree)


def common_length(what: str, tree: Any) -> tuple[int | None, list[str]]:
    """Returns the length of the leading axis that all leaves share, or None and a sentence.

    Args:
        what: the pytree, for the sentence.
        tree: pytree of arrays or of their shapes.
    """
    leaves = jax.tree.leaves(tree)
    lengths = {leaf.shape[0] if getattr(leaf, "shape", ()) else None for leaf in leaves}
    if len(lengths) == 1 and None not in lengths:
        return lengths.pop(), []
    shapes = ", ".join(described(leaf) for leaf in leaves[:6]) or "no arrays"
    return None, [f"{what} holds {shapes}; all must have one leading axis of the same length"]
