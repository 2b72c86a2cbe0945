"""Facts that a job depends on, kept beside its checkpoints: it resumes only where they agree."""

import ast
import contextlib
import functools
import hashlib
import importlib.metadata
import importlib.util
import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import numpy as np

import rp_jax
from rp_jax import storage
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.envs.contract import FUNCTIONS
from rp_jax.planning.wrapped import Wrapped

CHECKPOINTS = "checkpoints"  # folder inside that of a job, until it is finished
LOCK = "lock"  # held by the process that is at work on a job
CONFIG = (  # values of jax.config that change draws or last bits, however they were set
    "jax_default_device",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_disable_jit",
    "jax_disable_most_optimizations",
    "jax_enable_x64",
    "jax_exec_time_optimization_effort",
    "jax_explicit_x64_dtypes",
    "jax_high_dynamic_range_gumbel",
    "jax_numpy_dtype_promotion",
    "jax_optimization_level",
    "jax_random_seed_offset",
    "jax_softmax_custom_jvp",
    "jax_threefry_partitionable",
)
VARIABLES = ("XLA_FLAGS", "LIBTPU_INIT_ARGS", "NVIDIA_TF32_OVERRIDE")  # read outside jax.config
LIBRARIES = ("rp_jax", "jax", "jaxlib", "flax", "optax", "flashbax", "numpy", "scipy")
SHOWN_BY = ("matplotlib", "rich", "tyro")  # packages in which nothing is computed
OUTSIDE = ("cli", "plot")  # folders of the library in which nothing is computed


def machine(env: Any) -> dict[str, Any]:
    """Returns what must not change for a job to come to the same bits.

    Args:
        env: the environment, or the module of a script; its source counts as well, where it is
            not the library's.
    """
    device = jax.devices()[0]
    return {
        "versions": versions_of(env),
        "device": f"{device} ({device.device_kind})",
        "flags": flags(),
        "code": code_of(env),
    }


def flags() -> dict[str, str]:
    """Returns the settings of this process that change numbers: of jax.config, and variables.

    The values are those in force, whether they were set by an environment variable, by
    `jax.config.update` or by a context manager; "" stands for a setting that there is not.
    """
    known = jax.config.values
    of = lambda name: getattr(jax.config, name, known.get(name, ""))  # noqa: E731
    variables = {name: os.environ.get(name, "") for name in VARIABLES}
    return {name: str(of(name)) for name in CONFIG} | variables


def versions_of(env: Any) -> dict[str, str]:
    """Returns the versions of what computes a job: this library's, and the world's own packages.

    Args:
        env: the environment, or the module of a script.

    Returns:
        By name of the package, as it is installed.
    """
    names = {*LIBRARIES[1:], *_packages_of(env)}
    return {"rp_jax": rp_jax.__version__} | {
        name: importlib.metadata.version(name) for name in sorted(names)
    }


def _packages_of(env: Any) -> set[str]:
    """Returns the installed packages, beside the usual ones, that the files of a world import.

    The adapters that the world is built on count as its own files: they import brax.
    """
    own = sources_of(env)
    imported = {name for file in own.values() for name in _imports_of(file, "")}
    adapters = Path(rp_jax.__file__).parent / "adapters"
    for file in adapters.glob("*.py"):
        if f"rp_jax.adapters.{file.stem}" in imported:
            imported |= _imports_of(file, "rp_jax.adapters")
    tops = {name.partition(".")[0] for name in imported} - {name.partition(".")[0] for name in own}
    foreign = tops - sys.stdlib_module_names - {"rp_jax", *SHOWN_BY, *LIBRARIES}
    return {package for top in foreign for package in _distributions().get(top, ())}


@functools.cache
def _distributions() -> Mapping[str, list[str]]:
    """Returns the installed packages by the name that each is imported by."""
    return importlib.metadata.packages_distributions()


def name_of(env: Any) -> str:
    """Returns the name that an environment can be imported by, or that of its class.

    Args:
        env: a module, or an object; of a world with a threshold or a budget in its states, what
            counts is the world inside.
    """
    if isinstance(env, Wrapped):
        return name_of(env.env)
    return getattr(env, "__name__", None) or f"{type(env).__module__}.{type(env).__qualname__}"


def short_name(env: Any) -> str:
    """Returns the name of an environment for people: that of `name_of`, without "rp_jax.envs.".

    Args:
        env: a module, or an object.
    """
    return name_of(env).removeprefix("rp_jax.envs.")


def code_of(env: Any) -> dict[str, str]:
    """Returns checksums of the source that computes a job: of the library, and of other modules.

    Args:
        env: the environment, or the module of a script.

    Returns:
        By name of the module; "rp_jax" stands for the library.
    """
    others = {name: _sha256([file]) for name, file in sorted(sources_of(env).items())}
    return {"rp_jax": library_code(), **others}


@functools.cache
def library_code() -> str:
    """Returns the checksum of the library's source, but for what shows results."""
    library = Path(rp_jax.__file__).parent
    return _sha256(
        file
        for file in sorted(library.glob("**/*.py"))
        if file.relative_to(library).parts[0] not in OUTSIDE
    )


def _sha256(files: Iterable[Path]) -> str:
    """Returns the first 16 digits of the checksum of some files."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def sources_of(env: Any) -> dict[str, Path]:
    """Returns the files of an environment's modules, and of what these import from their package.

    For a module without a package, these are the modules and packages beside it. Files of the
    library itself do not count, nor do those of other packages.

    Args:
        env: a module, a class, or an object; a wrapper with a field `env` counts together with what
            it wraps.

    Returns:
        By name of the module.

    Raises:
        ValueError: a file cannot be parsed.
    """
    left, found, library = _modules_of(env), {}, Path(rp_jax.__file__).parent
    while left:
        name, file = left.popitem()
        if name not in found and not file.is_relative_to(library):
            found[name] = file
            left |= _own_imports(name, file)
    return found


def _modules_of(env: Any) -> dict[str, Path]:
    """Returns the files of the modules in which an environment and its functions are defined."""
    names: set[Any] = set()
    seen: list[Any] = []
    while env is not None and not any(env is one for one in seen):
        seen.append(env)
        parts = [getattr(env, function, None) for function in FUNCTIONS]
        names |= {getattr(part, "__module__", None) for part in parts}
        names |= {name_of_module(env)}
        env = None if isinstance(env, ModuleType) else getattr(env, "env", None)
    modules = [sys.modules[n] for n in names if n in sys.modules]
    files = {m.__name__: Path(getattr(m, "__file__", None) or "") for m in modules}
    own = {name: file for name, file in files.items() if file.suffix == ".py"}
    foreign = sys.stdlib_module_names
    return {name: file for name, file in own.items() if name.partition(".")[0] not in foreign}


def name_of_module(env: Any) -> str:
    """Returns the name of the module that an environment is, or is defined in.

    Args:
        env: a module, a class, or an object.
    """
    if isinstance(env, Wrapped):
        return name_of_module(env.env)
    if isinstance(env, ModuleType):
        return env.__name__
    return env.__module__ if isinstance(env, type) else type(env).__module__


def _own_imports(name: str, file: Path) -> dict[str, Path]:
    """Returns the modules that a file imports from its own package, or from beside it."""
    module = sys.modules.get(name)
    spec = getattr(module, "__spec__", None)
    whole = spec.name if spec is not None else name  # of a script that runs as __main__, too
    package = whole if file.name == "__init__.py" else whole.rpartition(".")[0]
    depth = len(package.split(".")) if package else 0
    root = file.parents[depth]  # the folder that the package, or the module, is in
    names = _imports_of(file, package)
    if package:
        names = {name for name in names if name.partition(".")[0] == package.partition(".")[0]}
    parts = [name.split(".") for name in names]
    wanted = {".".join(part[:k]) for part in parts for k in range(1, len(part) + 1)}
    found = {}
    for other in wanted:
        place = root.joinpath(*other.split("."))
        for candidate in (place.with_suffix(".py"), place / "__init__.py"):
            if candidate.is_file():
                found[other] = candidate
    return found


def _imports_of(file: Path, package: str) -> set[str]:
    """Returns the names that a file imports, in full; also of functions and classes.

    Args:
        file: of a module.
        package: that it is in; "" leaves relative imports out.
    """
    try:
        tree = ast.parse(file.read_bytes())
    except SyntaxError as error:
        raise ValueError(f"{file} cannot be parsed ({error})") from error
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (package or not node.level):
            base = "." * node.level + (node.module or "")
            base = importlib.util.resolve_name(base, package) if node.level else base
            names |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    return names


def digest_of(tree: Any) -> str:
    """Returns the checksum of a pytree: its structure, its arrays, and what is static in it.

    Args:
        tree: any pytree of arrays and keys; static fields count by their text, `storage.text`.
    """
    statics = {name: storage.text(value) for name, value in storage.statics(tree).items()}
    digest = hashlib.sha256(repr(statics).encode())
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
            if name.startswith("code: "):
                file = name.removeprefix("code: ")
                raise ValueError(
                    f"{where}; its code of {file} has the checksum {odd}, that of here {now}; it "
                    "must be the same to come to the same bits: go on with the source that it was "
                    "begun with, or begin in another folder"
                )
            raise ValueError(
                f"{where}; its {name} is {odd}; it must be {now} to come to the same bits: repeat "
                f"the call that began it, or begin in another folder{_why(odd)}"
            )


def _why(odd: Any) -> str:
    """Returns what a user may not think of, where a checksum of arrays differs."""
    if not (isinstance(odd, str) and re.fullmatch("[0-9a-f]{32}", odd)):
        return ""
    return (
        " (a checksum of its numbers; these also differ with the precision: jax_enable_x64 is "
        f"{flags()['jax_enable_x64']} here)"
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
    place, wanted = Path(folder) / CHECKPOINTS / storage.file_name(name), plain(spec)
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
