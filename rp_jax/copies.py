"""Deep copies of objects that hold an environment, which may be a module."""

import dataclasses
import functools
from collections.abc import Callable
from types import ModuleType
from typing import Any


def parts(self: Any) -> tuple[Callable, tuple]:
    """Returns how a copy of an object is made, for a class to take as its `__reduce__`.

    A deep copy shares what the function holds, and copies its arguments. Python cannot copy
    modules, so they are shared, and so are the static fields of a pytree: constants of the programs
    compiled for it, which then serve its copies too.

    Args:
        self: a dataclass, a named tuple, or another object with attributes.

    Returns:
        A function and its arguments.
    """
    values = self._asdict() if isinstance(self, tuple) else vars(self)  # type: ignore[attr-defined]
    fields = dataclasses.fields(self) if dataclasses.is_dataclass(self) else ()
    static = {field.name for field in fields if not field.metadata.get("pytree_node", True)}
    shared = {k: v for k, v in values.items() if k in static or isinstance(v, ModuleType)}
    copied = {k: v for k, v in values.items() if k not in shared}
    return functools.partial(_made, type(self), shared), (copied,)


def _made(kind: type, shared: dict[str, Any], copied: dict[str, Any]) -> Any:
    """Returns an object with the given attributes."""
    if issubclass(kind, tuple):
        return kind(**shared, **copied)
    made = object.__new__(kind)
    vars(made).update(shared | copied)
    return made
