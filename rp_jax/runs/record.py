"""Facts that a job depends on, kept beside its checkpoints: it resumes only where they agree."""

import contextlib
import functools
import hashlib
import importlib.metadata
import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

import rp_jax
from rp_jax import storage
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints

CHECKPOINTS = "checkpoints"  # folder inside that of a job, until it is finished
LOCK = "lock"  # held by the process that is at work on a job
FLAGS = (  # they change draws or last bits
    "XLA_FLAGS",
    "JAX_DEFAULT_MATMUL_PRECISION",
    "JAX_ENABLE_X64",
    "JAX_THREEFRY_PARTITIONABLE",
)
LIBRARIES = ("rp_jax", "jax", "jaxlib", "flax", "optax", "flashbax", "numpy")
OUTSIDE = ("cli", "plot")  # folders of the library in which nothing is computed


def machine(env: Any) -> dict[str, Any]:
    """Returns what must not change for a job to come to the same bits.

    Args:
        env: the environment, or the module of a script; its source counts as well where it is not
            the library's.
    """
    return {
        "versions": {name: _version(name) for name in LIBRARIES},
        "device": str(jax.devices()[0]),
        "flags": {name: os.environ.get(name, "") for name in FLAGS},
        "code": code_of(source_of(env)),
    }


def _version(library: str) -> str:
    if library == "rp_jax":
        return rp_jax.__version__
    return importlib.metadata.version(library)


def name_of(env: Any) -> str:
    """Returns the name that an environment can be imported by, or that of its class.

    Args:
        env: a module, or an object.
    """
    return getattr(env, "__name__", None) or f"{type(env).__module__}.{type(env).__qualname__}"


def short_name(env: Any) -> str:
    """Returns the name of an environment for people: that of `name_of`, without "rp_jax.envs.".

    Args:
        env: a module, or an object.
    """
    return name_of(env).removeprefix("rp_jax.envs.")


def source_of(env: Any) -> Path | None:
    """Returns the folder with the source of an environment that is not the library's own.

    Args:
        env: a module, or an object.
    """
    module = env if hasattr(env, "__file__") else sys.modules.get(type(env).__module__)
    file = getattr(module, "__file__", None)
    if file is None or Path(file).is_relative_to(Path(rp_jax.__file__).parent):
        return None
    return Path(file).parent


@functools.cache
def code_of(folder: Path | None) -> str:
    """Returns the checksum of the source that computes a job.

    Args:
        folder: with the source of an environment of one's own; None for the library's.
    """
    library = Path(rp_jax.__file__).parent
    files = [
        file
        for file in sorted(library.glob("**/*.py"))
        if file.relative_to(library).parts[0] not in OUTSIDE
    ]
    digest = hashlib.sha256()
    for file in [*files, *(sorted(folder.glob("*.py")) if folder else [])]:
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def digest_of(tree: Any) -> str:
    """Returns the checksum of a pytree: its structure, its arrays, and what is static in it.

    Args:
        tree: any pytree of arrays and keys; static fields count by their text.
    """
    digest = hashlib.sha256(repr(storage.statics(tree)).encode())
    for name, array in storage.leaves(tree).items():
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()[:32]


def plain(value: Any) -> Any:
    """Returns a value as it comes back from a JSON file.

    Args:
        value: dataclasses, tables, lists, arrays, paths and numbers.
    """
    return json.loads(json.dumps(storage.plain(value)))


def compared(where: str, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Raises ValueError, naming it, if what a job depended on is not what it depends on now.

    Args:
        where: for the message, such as "folder is results/mine".
        found: facts as they were kept.
        wanted: facts as they are.
    """
    for name, value in wanted.items():
        if found.get(name) != value:
            odd, now = found.get(name), value
            if isinstance(odd, dict) and isinstance(now, dict):
                keys = [k for k in {**odd, **now} if odd.get(k) != now.get(k)]
                name = f"{name}: {keys[0]}"
                odd, now = odd.get(keys[0]), now.get(keys[0])
            raise ValueError(
                f"{where}; its {name} is {odd}; it must be {now} to come to the same bits"
            )


@contextlib.contextmanager
def job(
    folder: Path | None,
    name: str,
    spec: Mapping[str, Any],
    say: Callable[[str], None] = print,
) -> Iterator[Checkpoints]:
    """Keeps the checkpoints of a job inside a folder while it runs, and removes them at its end.

    Args:
        folder: of the results; None keeps nothing.
        name: of the job: several may share a folder, one after another.
        spec: all that the result depends on.
        say: told what was done already.

    Raises:
        ValueError: the folder has checkpoints of the same job with another `spec`.
        storage.StorageError: another process is at work on it, or it cannot be written.
    """
    if folder is None:
        yield NO_CHECKPOINTS
        return
    place, wanted = Path(folder) / CHECKPOINTS / re.sub(r"[^\w=. -]", "_", name), plain(spec)
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise storage.StorageError(f"{place}: cannot be created ({error.strerror})") from error
    with storage.locked(place, LOCK):
        storage.remove_partial_files(place)
        file = place / "spec.json"
        if file.exists():
            compared(f"folder is {folder}", read_json(file), wanted)
        else:
            storage.write_json(file, wanted)
        run = hashlib.sha256(json.dumps(wanted, sort_keys=True).encode()).hexdigest()
        yield Checkpoints(place, run=run, name=name, say=say)
        shutil.rmtree(place)
    with contextlib.suppress(OSError):  # where another job is not finished
        place.parent.rmdir()


def read_json(path: Path) -> dict[str, Any]:
    """Returns the table in a JSON file.

    Args:
        path: of the file.

    Raises:
        storage.StorageError: it is missing, unreadable, or no table.
    """
    try:
        found = json.loads(Path(path).read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise storage.StorageError(f"{path}: cannot be read ({error})") from error
    if not isinstance(found, dict):
        raise storage.StorageError(f"{path}: it must be a table")
    return found


def key_data(key: jax.Array) -> list[int]:
    """Returns the words of a key, to be kept in a file.

    Args:
        key: a typed key.
    """
    return np.asarray(jax.random.key_data(key)).ravel().tolist()
