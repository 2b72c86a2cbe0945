"""config.json of a run: written at its beginning, read back to use or to resume the run."""

import dataclasses
import functools
import hashlib
import importlib.util
import json
import os
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax

import rp_jax
from experiments import console
from rp_jax import storage
from rp_jax.checkpoints import Checkpoints

CHECKPOINTS = "checkpoints"  # folder inside that of a run, until the run is finished
LOCK = f"{CHECKPOINTS}/lock"  # held by the process that is at work on a run
FLAGS = ("XLA_FLAGS", "JAX_DEFAULT_MATMUL_PRECISION", "JAX_ENABLE_X64")  # they change last bits
DRAWN = ("all.py", "console.py", "drawing.py", "report.py")  # nothing is computed there


def machine(experiment: str) -> dict[str, Any]:
    """What must not change for a run of an experiment to be resumed to the same bits."""
    return {
        "versions": {"rp_jax": rp_jax.__version__, "jax": jax.__version__},
        "device": str(jax.devices()[0]),
        "flags": {name: os.environ.get(name, "") for name in FLAGS},
        "code": code(experiment),
    }


@functools.cache
def code(experiment: str) -> str:
    """Checksum of the source that computes a run; what only draws or reports is not in it.

    Args:
        experiment: name of its module. If that lives elsewhere, its folder belongs to it.
    """
    here, library = Path(__file__).parent, Path(rp_jax.__file__).parent
    files = [*sorted(library.glob("**/*.py")), *sorted(here.glob("*.py"))]
    try:
        found = importlib.util.find_spec(experiment)
    except (ModuleNotFoundError, ValueError):  # of a package that is not there; of __main__
        found = None
    if found and found.origin and Path(found.origin).parent != here:
        files += sorted(Path(found.origin).parent.glob("*.py"))
    drawn = {here / name for name in DRAWN}
    digest = hashlib.sha256()
    for file in files:
        if file not in drawn and not file.is_relative_to(library / "plot"):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def begin(folder: Path, experiment: str, settings: Mapping[str, Any]) -> Checkpoints:
    """Writes config.json of a new run of an experiment.

    Raises:
        storage.StorageError: another process has just begun one there.
    """
    try:
        (folder / CHECKPOINTS).mkdir()
    except FileExistsError:
        raise storage.StorageError(f"out is {folder}; another run has begun there") from None
    plain = {"experiment": experiment, **settings, **machine(experiment)}
    storage.write_json(folder / "config.json", plain)
    return checkpoints_of(folder)


def checkpoints_of(folder: Path) -> Checkpoints:
    """Those of a run that has begun; they hold for its config.json alone."""
    digest = hashlib.sha256((folder / "config.json").read_bytes()).hexdigest()
    return Checkpoints(folder / CHECKPOINTS, run=digest, say=console.say)


def read(folder: Path) -> dict[str, Any]:
    """config.json.

    Raises:
        storage.StorageError: it is missing or unreadable.
    """
    path = folder / "config.json"
    try:
        settings = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise storage.StorageError(f"{path}: cannot be read ({error})") from error
    if not isinstance(settings, dict):
        raise storage.StorageError(f"{path}: it must be a table")
    return settings


def interrupted(folder: Path, experiment: str) -> dict[str, Any]:
    """config.json of a run that an experiment can go on with here.

    Raises:
        ValueError: it is no run, it is finished, or was begun by something else or elsewhere.
    """
    settings = read(folder)
    if not (folder / CHECKPOINTS).is_dir():
        raise ValueError(
            f"resume is {folder}; it must be an interrupted run, but there are no checkpoints: "
            "it is finished"
        )
    for name, here in {"experiment": experiment, **machine(experiment)}.items():
        if settings.get(name) != here:
            raise ValueError(
                f"resume is {folder}; its {name} is {settings.get(name)}; it must be {here} to "
                "come to the same bits"
            )
    return settings


def restored(kind: type, plain: Any, where: str) -> Any:
    """A dataclass from what `storage.write_json` made of it. Fields not there keep their default.

    Raises:
        storage.StorageError: a value is not of its field's type, or one without a default is not
            there.
    """
    if not isinstance(plain, Mapping):
        raise storage.StorageError(f"{where}: it is {plain!r}; it must be a table")
    types_of = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        missing = field.default is field.default_factory is dataclasses.MISSING
        if missing and field.name not in plain:
            raise storage.StorageError(f"{where}: {field.name} is missing; it must be there")
    names = [f.name for f in dataclasses.fields(kind) if f.name in plain]
    return kind(**{n: _value(types_of[n], plain[n], f"{where}: {n}") for n in names})


def _value(kind: Any, plain: Any, where: str) -> Any:
    if dataclasses.is_dataclass(kind):
        return restored(typing.cast(type, kind), plain, where)
    options = typing.get_args(kind)
    if isinstance(kind, types.UnionType):
        return None if plain is None else _value(options[0], plain, where)
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
