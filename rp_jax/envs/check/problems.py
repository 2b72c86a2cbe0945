"""Problems of an environment, each told in a sentence."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np

from rp_jax.validate import shown


class EnvError(ValueError):
    """An environment does not fulfil its contract.

    Attributes:
        problems: one sentence for each problem found.
    """

    problems: tuple[str, ...]

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__(self.problems)

    def __str__(self) -> str:
        if len(self.problems) == 1:
            return self.problems[0]
        lines = [f"{i}. {problem}" for i, problem in enumerate(self.problems, 1)]
        return "\n".join([f"{len(lines)} problems were found:", *lines])


def attempted(what: str, check: Callable[[], list[str]]) -> list[str]:
    """Returns what a check finds, or a sentence if it raises an exception.

    Args:
        what: what the check does, for the sentence.
        check: returns one sentence for each problem.
    """
    try:
        return check()
    except Exception as error:
        return [f"{what} raises {trouble(error)}"]


def trouble(error: Exception) -> str:
    """Returns the type and the first line of an exception's message.

    Args:
        error: the exception.
    """
    lines = str(error).strip().splitlines() or ["without a message"]
    return f"{type(error).__name__}: {lines[0][:300]}"


def number_of(part: int, whole: int, things: str) -> str:
    """Returns a text such as "3 of 1,000 steps".

    Args:
        part: how many of them.
        whole: how many there are.
        things: their name, in the plural.
    """
    return f"{part:,} of {whole:,} {things}"


def value_of(array: Any) -> str:
    """Returns a short text of the values of an array or a pytree of arrays.

    Args:
        array: an array, or a pytree of arrays.
    """
    values = np.concatenate([np.ravel(np.asarray(leaf)) for leaf in jax.tree.leaves(array)])
    few = ", ".join(f"{value:.6g}" for value in values[:8].astype(float))
    text = few if len(values) <= 8 else f"{few}, ..."
    return text if len(values) == 1 else f"[{text}]"


def plain(value: Any) -> str:
    """Returns what a sentence says of a setting: a number with its type, or as it is shown.

    Args:
        value: of the setting.
    """
    if isinstance(value, jax.Array | np.ndarray | np.generic) and value.ndim == 0:
        return f"{value:.6g} ({value.dtype})"
    return shown(value)


def described(leaf: Any) -> str:
    """Returns the type and the shape of a leaf, such as "float32[3, 2]".

    Args:
        leaf: an array, or anything else.
    """
    if hasattr(leaf, "shape") and hasattr(leaf, "dtype"):
        return f"{leaf.dtype}{list(leaf.shape)}"
    return shown(leaf)


def same_structure(one: Any, other: Any) -> bool:
    """Returns whether two pytrees have the same structure.

    Args:
        one: a pytree.
        other: another.
    """
    return str(jax.tree.structure(one)) == str(jax.tree.structure(other))


def differences(name: str, found: Any, allowed: Any) -> list[str]:
    """Returns a sentence for each leaf whose structure, shape or type is not the allowed one.

    Args:
        name: of the pytree.
        found: pytree of arrays or of their shapes.
        allowed: a pytree alike.
    """
    if not same_structure(found, allowed):
        mine, theirs = (_paths(tree) for tree in (found, allowed))
        if set(mine) == set(theirs):
            ours, yours = (str(jax.tree.structure(tree))[:200] for tree in (found, allowed))
            return [f"{name} has the structure {ours}; it must be {yours}"]
        more = [f"{name}{path}" for path in mine if path not in theirs]
        less = [f"{name}{path}" for path in theirs if path not in mine]
        parts = [f"has {', '.join(more[:4])}"] * bool(more)
        parts += [f"lacks {', '.join(less[:4])}"] * bool(less)
        return [f"{name} {' and '.join(parts)}; it must have the same fields as before"]
    pairs = zip(_paths(found).items(), jax.tree.leaves(allowed), strict=True)
    return [
        f"{name}{path} is {described(leaf)}; it must be {described(wanted)}"
        for (path, leaf), wanted in pairs
        if described(leaf) != described(wanted)
    ]


def _paths(tree: Any) -> dict[str, Any]:
    """The leaves of a pytree by their path."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}


@contextlib.contextmanager
def own_settings() -> Iterator[None]:
    """JAX settings under which environments are checked, whatever the caller's are."""
    with (
        jax.numpy_rank_promotion("allow"),
        jax.debug_nans(False),
        jax.default_matmul_precision("highest"),
    ):
        yield
