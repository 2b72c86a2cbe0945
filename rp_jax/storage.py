"""Files that are whole or absent: atomic writes, and arrays with a manifest of checksums."""

import hashlib
import io
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

FORMAT = 1  # of the manifest


class StorageError(ValueError):
    """A file is damaged, of another kind, or cannot be written."""


def write_bytes(path: Path, data: bytes) -> None:
    """Writes a file through a temporary one, so that it is never half there."""
    path = Path(path)
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror})") from error
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException as error:
        Path(name).unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise StorageError(f"{path}: cannot be written ({error.strerror})") from error
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


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
        taken = path.exists() and (not path.is_dir() or any(path.iterdir()))
        if not taken:
            path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"out is {path}; it cannot be created ({error.strerror})") from error
    if taken:
        raise StorageError(f"out is {path}; it must be a new or an empty folder, but this exists")
    if not os.access(path, os.W_OK):
        raise StorageError(f"out is {path}; it cannot be written")
    return path


def leaves(tree: Any) -> dict[str, np.ndarray]:
    """A pytree's arrays by their paths."""
    flat, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): np.asarray(a) for path, a in flat
    }


def save(folder: Path, kind: str, tree: Any, about: Mapping[str, Any]) -> None:
    """Saves a pytree's arrays as `arrays.npz`, and `manifest.json` with what is needed to check.

    Args:
        folder: created if missing; files in it are replaced.
        kind: what this is, asked for again by `load`.
        tree: any pytree of arrays.
        about: JSON-like facts about it.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"{folder}: cannot be created ({error.strerror})") from error
    arrays = leaves(tree)
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    data = buffer.getvalue()
    manifest = {
        "format": FORMAT,
        "kind": kind,
        "sha256": hashlib.sha256(data).hexdigest(),
        "bytes": len(data),
        "arrays": {n: {"shape": a.shape, "dtype": str(a.dtype)} for n, a in arrays.items()},
        "about": about,
    }
    write_bytes(folder / "arrays.npz", data)
    write_json(folder / "manifest.json", manifest)


def read_manifest(folder: Path, kind: str) -> dict[str, Any]:
    """The manifest of what `save` wrote.

    Raises:
        StorageError: it is missing, unreadable, or of another kind.
    """
    path = Path(folder) / "manifest.json"
    try:
        manifest = json.loads(path.read_text())
    except FileNotFoundError:
        raise StorageError(
            f"{folder}: there is no manifest.json; it is not a saved {kind}"
        ) from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise StorageError(f"{path}: cannot be read ({error})") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise StorageError(f"{path}: format is not {FORMAT}; the file is damaged or too new")
    if manifest.get("kind") != kind:
        raise StorageError(f"{path}: kind is {manifest.get('kind')!r}; it must be {kind!r}")
    if not isinstance(manifest.get("about"), dict) or not isinstance(manifest.get("arrays"), dict):
        raise StorageError(f"{path}: the fields 'about' and 'arrays' must be tables")
    return manifest


def load(folder: Path, kind: str, like: Any) -> Any:
    """The pytree that `save` wrote, in the structure of `like`.

    Every array must have the shape and type of its counterpart in `like`, and the file the
    checksum in the manifest.

    Raises:
        StorageError: anything is missing, damaged, or of another shape.
    """
    folder = Path(folder)
    manifest = read_manifest(folder, kind)
    path = folder / "arrays.npz"
    try:
        size = path.stat().st_size
        if size != manifest.get("bytes"):
            raise StorageError(f"{path}: {size} bytes; the manifest says {manifest.get('bytes')}")
        data = path.read_bytes()
    except OSError as error:
        raise StorageError(f"{path}: cannot be read ({error.strerror})") from error
    if hashlib.sha256(data).hexdigest() != manifest.get("sha256"):
        raise StorageError(f"{path}: the checksum differs from the manifest's; it is damaged")
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    expected = leaves(like)
    if set(arrays) != set(expected):
        odd = sorted(set(arrays) ^ set(expected))
        raise StorageError(f"{path}: arrays are missing or too many: {', '.join(odd[:4])}")
    for name, want in expected.items():
        have = arrays[name]
        if have.shape != want.shape or have.dtype != want.dtype:
            raise StorageError(
                f"{path}: {name} is {have.dtype}{list(have.shape)}; "
                f"it must be {want.dtype}{list(want.shape)}"
            )
    _, structure = jax.tree.flatten(like)
    return jax.tree.unflatten(structure, [jax.numpy.asarray(arrays[name]) for name in expected])
