"""Files that are either complete or absent: atomic writes, and arrays with checksums."""

import contextlib
import dataclasses
import functools
import hashlib
import json
import math
import os
import re
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import jax
import numpy as np

try:
    import fcntl
except ImportError:  # not on this system: folders are then not locked
    fcntl = None  # type: ignore[assignment]

FORMAT = 2  # version of the manifest's layout
PART = ".part"  # suffix of files that are still being written


PRECISIONS = ({"float32", "float64"}, {"int32", "int64"}, {"uint32", "uint64"})


class StorageError(ValueError):
    """A file is damaged, is of another kind, or cannot be written."""


class PrecisionError(StorageError):
    """Arrays were saved in single precision and are read in double, or the other way round."""


class PrecisionWarning(UserWarning):
    """Arrays were saved in another precision than they are read in, and were converted."""


def write_bytes(path: Path, data: bytes) -> None:
    """Writes a file so that it is either there completely or not at all.

    The data goes to a temporary file first, which then takes the place of `path`.

    Args:
        path: the file; its folder must exist.
        data: the file's content.

    Raises:
        StorageError: the file cannot be written; an earlier file of this name is left unchanged.
    """
    _write(Path(path), [memoryview(data)])


def _write(path: Path, parts: Iterable[memoryview]) -> None:
    """Writes parts one after another into one file, atomically; see `write_bytes`."""
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


def remove_partial_files(folder: Path) -> None:
    """Removes the temporary files of writes that were interrupted.

    Args:
        folder: searched with all its subfolders; no other process may be writing there.
    """
    for left in Path(folder).rglob(f".*{PART}"):
        with contextlib.suppress(OSError):
            left.unlink()


def _sync(folder: Path) -> None:
    """Makes the names in a folder survive a loss of power."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_json(path: Path, value: Any) -> None:
    """Writes readable JSON, atomically.

    Args:
        path: the file; its folder must exist.
        value: what JSON can hold, and arrays and paths. Nan becomes null; infinity becomes "inf".

    Raises:
        StorageError: the file cannot be written.
    """
    text = json.dumps(plain(value), indent=2, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def plain(value: Any) -> Any:
    """Returns a value converted to what JSON can represent.

    Args:
        value: mappings, sequences, dataclasses, arrays, paths, numbers and strings, nested.
            Dataclasses become mappings, arrays lists, paths strings, nan None, and infinity "inf"
            or "-inf". Keys of mappings become strings.

    Raises:
        ValueError: two keys of a mapping become the same string.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    if isinstance(value, Mapping):
        _check_apart("keys of a table", [str(k) for k in value])
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return plain(np.asarray(value).tolist())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None if np.isnan(value) else "inf" if value > 0 else "-inf"
    return value


def _check_apart(what: str, names: Sequence[str]) -> None:
    """Raises ValueError, naming one, if two names are the same: one of their values would be lost.

    Args:
        what: is named so.
        names: which must differ.
    """
    for name, count in Counter(names).items():
        if count > 1:
            raise ValueError(f"{what}: {name!r} is there {count} times; each must be there once")


def file_name(text: str) -> str:
    """Returns a name for a file or folder, another one for every text, on any file system.

    Texts of small letters, digits, spaces and a few signs are their own names. Others end with a
    checksum: where large and small letters are the same, or accents are written in several ways,
    texts that differ in these alone are kept apart.

    Args:
        text: any text, such as the name that a user gave to a test.
    """
    if re.fullmatch(r"(?=.*[a-z])[a-z0-9=_-](?:[a-z0-9=_. -]{0,98}[a-z0-9=_-])?", text):
        return text
    checksum = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()
    return f"{re.sub(r'[^A-Za-z0-9=_-]', '_', text)[:60]}~{checksum[:16]}"


def new_folder(path: Path) -> Path:
    """Creates a folder for results; one that exists must be empty.

    Args:
        path: the folder; missing parents are created.

    Returns:
        The folder's path.

    Raises:
        StorageError: the folder holds something, or cannot be created or written to.
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
    """Keeps other processes from working in a folder while the context lasts.

    The lock ends with the process, however that ends.

    Args:
        folder: the folder; messages name it.
        name: name of the lock, a file in the folder.

    Yields:
        The lock's file descriptor; a child process that inherits it holds the lock too.

    Raises:
        StorageError: another process is at work in the folder, or has just finished and removed
            the lock.
    """
    path = Path(folder) / name
    try:
        file = path.open("w")
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror})") from error
    with file:
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise StorageError(f"{folder}: another process is at work in this folder") from None
        except OSError:
            pass  # a file system without locks
        if not path.exists():
            raise StorageError(f"{folder}: another process has just finished in this folder")
        yield file.fileno()


def leaves(tree: Any) -> dict[str, np.ndarray]:
    """Returns the arrays of a pytree by their paths.

    Args:
        tree: any pytree of arrays, numbers and random keys; a key is represented by its data.
    """
    flat = _flat(jax.tree.map(_data, tree))
    return {name: np.asarray(_array(a), order="C") for name, a in flat.items()}


def statics(part: Any, path: str = "") -> dict[str, Any]:
    """Returns the fields of a tree of dataclasses that hold no arrays, by path.

    Args:
        part: a tree of flax's dataclasses, tables, lists and tuples, such as the parameters of an
            environment.
        path: prefix of the paths.
    """
    found: dict[str, Any] = {}
    if isinstance(part, list | tuple):
        part = dict(enumerate(part))
    if isinstance(part, Mapping):
        _check_apart(f"keys of {path or 'a tree'}", [str(name) for name in part])
        for name, value in part.items():
            found |= statics(value, f"{path}{_escaped(str(name))}/")
    for field in dataclasses.fields(part) if dataclasses.is_dataclass(part) else ():
        value, name = getattr(part, field.name), path + field.name
        if field.metadata.get("pytree_node", True):
            found |= statics(value, f"{name}/")
        else:
            found[name] = value
    return found


def text(value: Any) -> str:
    """Returns the text of a static value, the same in every process, and another for another value.

    Args:
        value: numbers and strings have their usual text, and so have lists, tuples and tables of
            them. Functions are told by their name, code, defaults and closure; objects whose usual
            text would say where they are in memory by their class and fields; arrays by a checksum.
    """
    return _text(value, ())


def _text(value: Any, above: tuple) -> str:
    """Returns the text of a value inside others, which may refer back to these."""
    if any(value is one for one in above):
        return "..."
    of = lambda part: _text(part, (*above, value))  # noqa: E731
    if _is_plain(value):
        return str(value)
    if isinstance(value, ModuleType):
        return value.__name__
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{of(k)}: {of(v)}' for k, v in value.items())}}}"
    if isinstance(value, set | frozenset):
        return f"{{{', '.join(sorted(map(of, value)))}}}"
    if isinstance(value, list | tuple):
        return f"({', '.join(map(of, value))})"
    if isinstance(value, np.ndarray | jax.Array):
        array = np.asarray(_data(value))
        return f"{array.dtype}{array.shape} {hashlib.sha256(array.tobytes()).hexdigest()}"
    if isinstance(value, functools.partial):
        return f"partial{of((value.func, value.args, value.keywords))}"
    if isinstance(value, MethodType):
        return f"{of(value.__func__)} of {of(value.__self__)}"
    if isinstance(value, FunctionType):
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        parts = (value.__code__, value.__defaults__, value.__kwdefaults__, cells)
        return f"{value.__module__}.{value.__qualname__}{of(parts)}"
    if isinstance(value, CodeType):
        return hashlib.sha256(value.co_code).hexdigest() + of((value.co_consts, value.co_names))
    if hasattr(value, "__wrapped__"):  # as jax.jit leaves it
        return f"{type(value).__qualname__}({of(value.__wrapped__)})"
    found = str(value)
    if " at 0x" not in found:
        return found
    slots = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ())]
    fields = {name: getattr(value, name) for name in slots if hasattr(value, name)}
    fields |= getattr(value, "__dict__", {})
    if not fields:
        return found  # nothing is known of it: equal to itself alone
    return f"{type(value).__module__}.{type(value).__qualname__}{of(fields)}"


def _is_plain(value: Any) -> bool:
    """Returns whether a value is of numbers and strings alone, in lists, tuples and tables."""
    if isinstance(value, Mapping):
        return all(map(_is_plain, [*value, *value.values()]))
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, str | int | float | bool | bytes)


def _flat(tree: Any) -> dict[str, Any]:
    """Returns the leaves of a pytree by their paths, such as "params/dense/kernel".

    In keys with "/" or "~" these are written "~1" and "~0", as in a JSON pointer (RFC 6901), so
    that {"a/b": x} and {"a": {"b": x}} have paths of their own.

    Raises:
        ValueError: two keys that are not strings have the same text.
    """
    flat, _ = jax.tree_util.tree_flatten_with_path(tree)
    part = lambda key: _escaped(jax.tree_util.keystr((key,), simple=True))  # noqa: E731
    names = ["/".join(map(part, path)) for path, _ in flat]
    _check_apart("paths of arrays", names)
    return {name: a for name, (_, a) in zip(names, flat, strict=True)}


def _escaped(key: str) -> str:
    """Returns a key as a part of a path, without "/"."""
    return key.replace("~", "~0").replace("/", "~1")


def _is_key(a: Any) -> bool:
    """Returns whether a leaf is a typed random key."""
    return hasattr(a, "dtype") and jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key)


def _data(a: Any) -> Any:
    """Returns a random key's data, and any other leaf unchanged."""
    return jax.random.key_data(a) if _is_key(a) else a


def _array(a: Any) -> Any:
    """Returns a plain number as the array that JAX takes it for, and any other leaf unchanged."""
    return a if hasattr(a, "dtype") else np.asarray(jax.numpy.asarray(a))


def _facts(array: Any) -> dict[str, Any]:
    """Returns shape and type of an array, or of a stand-in such as `jax.ShapeDtypeStruct`."""
    if _is_key(array):
        array = jax.eval_shape(jax.random.key_data, array)
    array = _array(array)
    return {"shape": list(array.shape), "dtype": str(array.dtype)}


def _size(facts: Mapping[str, Any]) -> int:
    """Returns the number of bytes of an array with this shape and type."""
    return math.prod(facts["shape"]) * jax.numpy.dtype(facts["dtype"]).itemsize


def _arrays_file(folder: Path, sha256: str) -> Path:
    """Returns the file that holds the arrays with this checksum."""
    return folder / f"arrays-{sha256[:16]}.bin"


def manifest_checksum(manifest: Mapping[str, Any]) -> str:
    """Returns the checksum of a manifest.

    Args:
        manifest: its fields; one named "seal" is left out.

    Returns:
        SHA-256 as 64 hexadecimal digits.
    """
    rest = {key: value for key, value in manifest.items() if key != "seal"}
    return hashlib.sha256(json.dumps(rest).encode()).hexdigest()


def checksum(tree: Any) -> str:
    """Returns the SHA-256 that `save` would state of the arrays of a pytree.

    Args:
        tree: any pytree of arrays and random keys.
    """
    return _checksum(_raw(leaves(tree)))


def _raw(arrays: Mapping[str, np.ndarray]) -> list[memoryview]:
    """Returns the bytes of arrays."""
    return [a.reshape(-1).view(np.uint8).data for a in arrays.values()]


def _checksum(raw: list[memoryview]) -> str:
    """Returns the SHA-256 of parts, one after another."""
    digest = hashlib.sha256()
    for part in raw:
        digest.update(part)
    return digest.hexdigest()


def save(folder: Path, kind: str, tree: Any, about: Mapping[str, Any]) -> None:
    """Saves the arrays of a pytree, with a manifest from which they can be read and checked.

    The arrays lie one after another, in C order, in a file named after its checksum. The file
    `manifest.json` is written last: until then, whatever was saved in the folder before stays
    complete and valid.

    Args:
        folder: created if it is missing.
        kind: name for the kind of content; `load` asks for it again.
        tree: any pytree of arrays and random keys.
        about: facts about the content, which `plain` must be able to convert.

    Raises:
        StorageError: the folder or a file cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _sync(folder.parent)
    except OSError as error:
        raise StorageError(f"{folder}: cannot be created ({error.strerror})") from error
    arrays = leaves(tree)
    raw = _raw(arrays)
    manifest = plain(
        {
            "format": FORMAT,
            "kind": kind,
            "sha256": _checksum(raw),
            "bytes": sum(len(part) for part in raw),
            "arrays": {name: _facts(a) for name, a in arrays.items()},
            "versions": {"jax": jax.__version__, "numpy": np.__version__},
            "about": about,
        }
    )
    file = _arrays_file(folder, manifest["sha256"])
    _write(file, raw)
    write_json(folder / "manifest.json", {**manifest, "seal": manifest_checksum(manifest)})
    for old in folder.glob("arrays*"):
        if old != file:
            with contextlib.suppress(OSError):
                old.unlink()


def read_manifest(folder: Path, kind: str) -> dict[str, Any]:
    """Returns the manifest that `save` wrote, checked.

    Args:
        folder: the folder given to `save`.
        kind: the kind given to `save`.

    Returns:
        Its fields: `about` (what `save` was given), `arrays` (shapes and types by path), and
        checksums.

    Raises:
        StorageError: the manifest is missing, unreadable, damaged, or of another kind.
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
    if manifest.get("seal") != manifest_checksum(manifest):
        raise StorageError(f"{path}: the checksum differs from its seal; it is damaged")
    return manifest


def load(folder: Path, kind: str, like: Any, *, convert: bool = False) -> Any:
    """Returns the pytree that `save` wrote, in the structure of `like`.

    Every array must have the shape and type of its counterpart in `like`, and the file must have
    the checksum that the manifest states. No memory is allocated for sizes that only the file
    claims.

    Args:
        folder: the folder given to `save`.
        kind: the kind given to `save`.
        like: pytree of arrays and random keys; `jax.ShapeDtypeStruct` may stand for an array. Where
            it has a numpy array, so has the result.
        convert: whether numbers of another precision (jax_enable_x64) are converted, which a
            `PrecisionWarning` tells of.

    Raises:
        PrecisionError: they are not to be converted, or cannot be.
        StorageError: something is missing, damaged, or of another shape.
    """
    folder = Path(folder)
    manifest = read_manifest(folder, kind)
    expected = _flat(like)
    facts = {name: _facts(a) for name, a in expected.items()}
    path = folder / "manifest.json"
    if set(manifest["arrays"]) != set(facts):
        odd = sorted(set(manifest["arrays"]) ^ set(facts))
        raise StorageError(f"{path}: arrays are missing or too many: {', '.join(odd[:4])}")
    saved = manifest["arrays"]
    others = [name for name, want in facts.items() if _check_facts(path, name, saved, want)]
    if others and not convert:
        raise PrecisionError(_told(path, others[0], saved, facts))
    data = _read_arrays(folder, manifest, sum(_size(saved[name]) for name in facts))
    found, start = {}, 0
    for name, have in saved.items():
        end = start + _size(have)
        array = _array_of(data[start:end], have)
        if have != facts[name]:
            array = _converted(array, facts[name]["dtype"], f"{path}: {name}")
        found[name] = _restored(array, expected[name])
        start = end
    if others:
        warnings.warn(_told(path, others[0], saved, facts), PrecisionWarning, stacklevel=2)
    return jax.tree.unflatten(jax.tree.structure(like), [found[name] for name in expected])


def load_some(folder: Path, kind: str, like: Mapping[str, Any]) -> dict[str, Any]:
    """Loads some of the arrays that `save` wrote, by their paths.

    Args:
        folder: the folder given to `save`.
        kind: the kind given to `save`.
        like: by path, arrays or `jax.ShapeDtypeStruct` of the wanted shapes and types.

    Returns:
        The arrays by path.

    Raises:
        StorageError: something is missing, damaged, or of another shape.
    """
    folder = Path(folder)
    manifest = read_manifest(folder, kind)
    path, facts = folder / "manifest.json", manifest["arrays"]
    for name, wanted in like.items():
        if facts.get(name) != _facts(wanted):
            raise StorageError(
                f"{path}: {name} is {_named(facts.get(name))}; it must be {_named(_facts(wanted))}"
            )
    try:
        data = _read_arrays(folder, manifest, sum(map(_size, facts.values())))
    except (TypeError, KeyError, ValueError) as error:
        raise StorageError(f"{path}: arrays cannot be read ({error})") from error
    found, start = {}, 0
    for name, about in facts.items():
        end = start + _size(about)
        if name in like:
            found[name] = _restored(_array_of(data[start:end], about), like[name])
        start = end
    return found


def _named(facts: Any) -> str:
    """Returns how a message shows an array's shape and type."""
    if isinstance(facts, dict):
        return f"{facts.get('dtype')}{facts.get('shape')}"
    return repr(facts)


def _read_arrays(folder: Path, manifest: Mapping[str, Any], size: int) -> memoryview:
    """Returns the bytes of all arrays, after checking their number and checksum."""
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


def _check_facts(path: Path, name: str, saved: Mapping[str, Any], want: Any) -> bool:
    """Returns whether an array was saved in another precision than is wanted.

    Raises:
        StorageError: it is of another shape, or another type altogether.
    """
    have = saved[name]
    if have == want:
        return False
    dtype = have.get("dtype") if isinstance(have, dict) else None
    same = isinstance(dtype, str) and have == {**want, "dtype": dtype}
    if same and {dtype, want["dtype"]} in PRECISIONS:
        return True
    raise StorageError(f"{path}: {name} is {_named(have)}; it must be {_named(want)}")


def _told(path: Path, name: str, saved: Mapping[str, Any], facts: Mapping[str, Any]) -> str:
    """Returns what is said of arrays in another precision."""
    have, want = saved[name], facts[name]
    double = have["dtype"].endswith("64")
    return (
        f"{path}: {name} is {_named(have)}, saved with jax_enable_x64={double}; here it is "
        f"{_named(want)}, with jax_enable_x64={not double}"
    )


def _converted(array: np.ndarray, dtype: str, where: str) -> np.ndarray:
    """Returns an array in another precision.

    Raises:
        PrecisionError: a number is too large for it.
    """
    with np.errstate(over="ignore"):
        found = array.astype(dtype)
    exact = found == array if found.dtype.kind in "iu" else np.isfinite(found) == np.isfinite(array)
    if not np.all(exact):
        raise PrecisionError(f"{where} is {array.dtype}; a number in it is too large for {dtype}")
    return found


def _array_of(data: memoryview, facts: Mapping[str, Any]) -> np.ndarray:
    """Returns one array from its bytes."""
    dtype = jax.numpy.dtype(facts["dtype"])
    return np.frombuffer(data, dtype).reshape(facts["shape"]).copy()


def _restored(array: np.ndarray, like: Any) -> Any:
    """Returns an array as a key, a numpy array or a JAX array, as `like` is."""
    if isinstance(like, np.ndarray | np.generic):
        return array[()]
    if _is_key(like):
        return jax.random.wrap_key_data(jax.numpy.array(array), impl=jax.random.key_impl(like))
    return jax.numpy.array(array)
