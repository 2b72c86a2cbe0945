"""Files that are whole or absent: atomic writes, and arrays with a manifest of checksums."""

import contextlib
import fcntl
import hashlib
import json
import math
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

FORMAT = 2  # of the manifest
PART = ".part"  # ends the names of files that are being written


class StorageError(ValueError):
    """A file is damaged, of another kind, or cannot be written."""


def write_bytes(path: Path, data: bytes) -> None:
    """Writes a file through a temporary one, so that it is never half there.

    Raises:
        StorageError: it cannot be written; what was there before is still there.
    """
    _write(Path(path), [memoryview(data)])


def _write(path: Path, parts: Iterable[memoryview]) -> None:
    name = None
    try:
        handle, name = tempfile.mkstemp(PART, f".{path.name}.", path.parent)
        with os.fdopen(handle, "wb") as file:
            for part in parts:
                file.write(part)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)
        os.replace(name, path)
        _sync(path.parent)
    except BaseException as error:
        if name is not None:
            with contextlib.suppress(OSError):
                os.unlink(name)
        if isinstance(error, OSError):
            raise StorageError(f"{path}: cannot be written ({error.strerror})") from error
        raise


def sweep(folder: Path) -> None:
    """Removes what writes left that ended with their process; no other may be at work in it."""
    for left in Path(folder).rglob(f".*{PART}"):
        with contextlib.suppress(OSError):
            left.unlink()


def _sync(folder: Path) -> None:
    """Names in a folder outlive a loss of power only after this."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_json(path: Path, value: Any) -> None:
    """Writes readable JSON, atomically. Nan and infinity become null and "inf"."""
    text = json.dumps(_plain(value), indent=2, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return _plain(np.asarray(value).tolist())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None if np.isnan(value) else "inf" if value > 0 else "-inf"
    return value


def new_folder(path: Path) -> Path:
    """Creates a folder for results.

    Raises:
        StorageError: it exists and holds something, or cannot be created or written.
    """
    path = Path(path)
    try:
        taken = False
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            taken = not path.is_dir() or any(path.iterdir())
    except OSError as error:
        raise StorageError(f"out is {path}; it cannot be created ({error.strerror})") from error
    if taken:
        raise StorageError(f"out is {path}; it must be a new or an empty folder, but this exists")
    if not os.access(path, os.W_OK):
        raise StorageError(f"out is {path}; it cannot be written")
    return path


@contextlib.contextmanager
def locked(folder: Path, name: str) -> Iterator[int]:
    """Keeps other processes from entering a folder; ends with the process, however that ends.

    Yields the lock's descriptor: a process that is given it holds the lock too.

    Args:
        folder: named in messages.
        name: of the lock, a file in it.

    Raises:
        StorageError: another process is inside, or has left and removed the lock.
    """
    path = Path(folder) / name
    try:
        file = path.open("w")
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror})") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StorageError(f"{folder}: another process is at work in this folder") from None
        except OSError:
            pass  # a file system without locks
        if not path.exists():
            raise StorageError(f"{folder}: another process has just finished in this folder")
        yield file.fileno()


def leaves(tree: Any) -> dict[str, np.ndarray]:
    """A pytree's arrays by their paths; of random keys, their data."""
    return {name: np.asarray(a, order="C") for name, a in _flat(jax.tree.map(_data, tree)).items()}


def _flat(tree: Any) -> dict[str, Any]:
    flat, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): a for path, a in flat}


def _is_key(a: Any) -> bool:
    return hasattr(a, "dtype") and jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key)


def _data(a: Any) -> Any:
    return jax.random.key_data(a) if _is_key(a) else a


def _facts(array: Any) -> dict[str, Any]:
    """Shape and type, of an array or of what stands for one."""
    if _is_key(array):
        array = jax.eval_shape(jax.random.key_data, array)
    if not hasattr(array, "dtype"):
        array = np.asarray(array)
    return {"shape": list(array.shape), "dtype": str(array.dtype)}


def _size(facts: Mapping[str, Any]) -> int:
    return math.prod(facts["shape"]) * jax.numpy.dtype(facts["dtype"]).itemsize


def _arrays_file(folder: Path, sha256: str) -> Path:
    return folder / f"arrays-{sha256[:16]}.bin"


def seal(manifest: Mapping[str, Any]) -> str:
    """The checksum of a manifest itself."""
    rest = {key: value for key, value in manifest.items() if key != "seal"}
    return hashlib.sha256(json.dumps(rest).encode()).hexdigest()


def save(folder: Path, kind: str, tree: Any, about: Mapping[str, Any]) -> None:
    """Saves a pytree's arrays, and `manifest.json` with what is needed to read and check them.

    The arrays lie one after another, in C order, in a file named after its checksum. The manifest
    is written last: until then, what was saved in the folder before is whole and is what counts.

    Args:
        folder: created if missing.
        kind: what this is, asked for again by `load`.
        tree: any pytree of arrays and random keys.
        about: JSON-like facts about it.

    Raises:
        StorageError: it cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _sync(folder.parent)
    except OSError as error:
        raise StorageError(f"{folder}: cannot be created ({error.strerror})") from error
    arrays = leaves(tree)
    raw = [a.reshape(-1).view(np.uint8).data for a in arrays.values()]
    digest = hashlib.sha256()
    for part in raw:
        digest.update(part)
    manifest = _plain(
        {
            "format": FORMAT,
            "kind": kind,
            "sha256": digest.hexdigest(),
            "bytes": sum(len(part) for part in raw),
            "arrays": {name: _facts(a) for name, a in arrays.items()},
            "versions": {"jax": jax.__version__, "numpy": np.__version__},
            "about": about,
        }
    )
    file = _arrays_file(folder, manifest["sha256"])
    _write(file, raw)
    write_json(folder / "manifest.json", {**manifest, "seal": seal(manifest)})
    for old in folder.glob("arrays*"):
        if old != file:
            with contextlib.suppress(OSError):
                old.unlink()


def read_manifest(folder: Path, kind: str) -> dict[str, Any]:
    """The manifest of what `save` wrote.

    Raises:
        StorageError: it is missing, unreadable, damaged, or of another kind.
    """
    path = Path(folder) / "manifest.json"
    try:
        manifest = json.loads(path.read_text())
    except FileNotFoundError:
        raise StorageError(
            f"{folder}: there is no manifest.json; it is not a saved {kind}"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise StorageError(f"{path}: cannot be read ({error})") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise StorageError(
            f"{path}: format is not {FORMAT}; the file is damaged, or too old or new"
        )
    if manifest.get("kind") != kind:
        raise StorageError(f"{path}: kind is {manifest.get('kind')!r}; it must be {kind!r}")
    if not isinstance(manifest.get("about"), dict) or not isinstance(manifest.get("arrays"), dict):
        raise StorageError(f"{path}: the fields 'about' and 'arrays' must be tables")
    if manifest.get("seal") != seal(manifest):
        raise StorageError(f"{path}: the checksum differs from its seal; it is damaged")
    return manifest


def load(folder: Path, kind: str, like: Any) -> Any:
    """The pytree that `save` wrote, in the structure of `like`.

    Every array must have the shape and type of its counterpart in `like`, and the file the
    checksum in the manifest. Nothing is allocated for sizes that only the file claims.

    Args:
        folder: given to `save`.
        kind: given to `save`.
        like: arrays and keys; for arrays, `jax.ShapeDtypeStruct`s will do. Where it has numpy's
            arrays, so has the result.

    Raises:
        StorageError: anything is missing, damaged, or of another shape.
    """
    folder = Path(folder)
    manifest = read_manifest(folder, kind)
    expected = _flat(like)
    facts = {name: _facts(a) for name, a in expected.items()}
    path = folder / "manifest.json"
    if set(manifest["arrays"]) != set(facts):
        odd = sorted(set(manifest["arrays"]) ^ set(facts))
        raise StorageError(f"{path}: arrays are missing or too many: {', '.join(odd[:4])}")
    for name, want in facts.items():
        have = manifest["arrays"][name]
        if have != want:
            raise StorageError(f"{path}: {name} is {_named(have)}; it must be {_named(want)}")
    data = _read_arrays(folder, manifest, sum(map(_size, facts.values())))
    found, start = {}, 0
    for name in manifest["arrays"]:
        want = facts[name]
        end = start + _size(want)
        found[name] = _restored(data[start:end], want, expected[name])
        start = end
    return jax.tree.unflatten(jax.tree.structure(like), [found[name] for name in expected])


def _named(facts: Any) -> str:
    if isinstance(facts, dict):
        return f"{facts.get('dtype')}{facts.get('shape')}"
    return repr(facts)


def _read_arrays(folder: Path, manifest: Mapping[str, Any], size: int) -> memoryview:
    """The bytes of all arrays, checked."""
    sha256 = str(manifest.get("sha256"))
    if manifest.get("bytes") != size or not re.fullmatch("[0-9a-f]{64}", sha256):
        raise StorageError(f"{folder / 'manifest.json'}: 'bytes' or 'sha256' cannot be right")
    path = _arrays_file(folder, sha256)
    try:
        there = path.stat().st_size
        if there != size:
            raise StorageError(f"{path}: {there} bytes; the manifest says {size}")
        data = path.read_bytes()
    except OSError as error:
        raise StorageError(f"{path}: cannot be read ({error.strerror})") from error
    if hashlib.sha256(data).hexdigest() != sha256:
        raise StorageError(f"{path}: the checksum differs from the manifest's; it is damaged")
    return memoryview(data)


def _restored(data: memoryview, facts: Mapping[str, Any], like: Any) -> Any:
    dtype = jax.numpy.dtype(facts["dtype"])
    array = np.frombuffer(data, dtype).reshape(facts["shape"]).copy()
    if isinstance(like, np.ndarray):
        return array
    if _is_key(like):
        return jax.random.wrap_key_data(jax.numpy.array(array), impl=jax.random.key_impl(like))
    return jax.numpy.array(array)
