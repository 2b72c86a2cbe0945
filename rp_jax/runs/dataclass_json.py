"""Dataclasses from JSON files, checked field by field."""

import dataclasses
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rp_jax import storage


def restored(kind: type, plain: Any, where: str) -> Any:
    """Returns a dataclass from what `storage.write_json` made of it.

    Args:
        kind: a dataclass or NamedTuple; fields that are not there keep their default.
        plain: a table.
        where: for messages.

    Raises:
        storage.StorageError: a value is not of its field's type, or one without a default is not
            there.
    """
    if not isinstance(plain, Mapping):
        raise storage.StorageError(f"{where}: it is {plain!r}; it must be a table")
    types_of = typing.get_type_hints(kind)
    for name in _needed(kind):
        if name not in plain:
            raise storage.StorageError(f"{where}: {name} is missing; it must be there")
    names = [name for name in types_of if name in plain]
    return kind(**{n: _value(types_of[n], plain[n], f"{where}: {n}") for n in names})


def _needed(kind: type) -> list[str]:
    """The fields without a default."""
    if dataclasses.is_dataclass(kind):
        fields = dataclasses.fields(kind)
        none = dataclasses.MISSING
        return [f.name for f in fields if f.default is f.default_factory is none]
    defaults: Mapping[str, Any] = getattr(kind, "_field_defaults", {})
    return [name for name in getattr(kind, "_fields", ()) if name not in defaults]


def _value(kind: Any, plain: Any, where: str) -> Any:
    if dataclasses.is_dataclass(kind):
        return restored(typing.cast(type, kind), plain, where)
    options = typing.get_args(kind)
    if isinstance(kind, types.UnionType):
        return None if plain is None else _value(options[0], plain, where)
    if typing.get_origin(kind) is dict and isinstance(plain, Mapping):
        return {str(k): _value(options[1], v, f"{where}: {k}") for k, v in plain.items()}
    if kind is Any:
        return plain
    if typing.get_origin(kind) is tuple and isinstance(plain, list):
        return tuple(_value(options[0], item, where) for item in plain)
    if kind is float and plain in ("inf", "-inf"):
        return float(plain)
    if kind is float and isinstance(plain, int | float) and not isinstance(plain, bool):
        return float(plain)
    if kind is Path and isinstance(plain, str):
        return Path(plain)
    if kind in (int, bool, str) and type(plain) is kind:
        return plain
    name = getattr(kind, "__name__", kind)
    raise storage.StorageError(f"{where} is {plain!r}; it must be of type {name}")
