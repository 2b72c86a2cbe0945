import errno
import functools
import json
import os
import re
import signal
import subprocess
import sys
import unicodedata
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from rp_jax import storage
from rp_jax.storage import StorageError

as_root = os.geteuid() == 0 if hasattr(os, "geteuid") else False


def fail(*args, **kwargs):
    raise OSError(errno.ENOSPC, "No space left on device")


def arrays_of(folder):
    (path,) = folder.glob("arrays-*.bin")
    return path


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_written_file_holds_exactly_what_was_written(tmp_path):
    path = tmp_path / "file"
    storage.write_bytes(path, b"one")
    storage.write_bytes(path, b"two\x00\xff")
    assert path.read_bytes() == b"two\x00\xff"
    assert names(tmp_path) == ["file"]
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("step", ["fsync", "replace", "chmod"])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(step, tmp_path, monkeypatch):
    path = tmp_path / "file"
    storage.write_bytes(path, b"old")
    monkeypatch.setattr(os, step, fail)
    with pytest.raises(StorageError, match=r"file: cannot be written \(No space left on device\)"):
        storage.write_bytes(path, b"new")
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["file"]


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    def interrupt(*args):
        raise KeyboardInterrupt

    path = tmp_path / "file"
    storage.write_bytes(path, b"old")
    monkeypatch.setattr(os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        storage.write_bytes(path, b"new")
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["file"]


def test_what_a_killed_write_left_is_swept_up(tmp_path):
    """Killed between the data and the name."""
    inner = tmp_path / "a"
    inner.mkdir()
    storage.write_bytes(inner / "file", b"old")
    code = (
        "import os, signal; from rp_jax import storage; "
        "os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL); "
        f"storage.write_bytes({str(inner / 'file')!r}, b'new')"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == -signal.SIGKILL
    (inner / ".hidden").touch()
    assert len(list(inner.iterdir())) == 3
    storage.remove_partial_files(tmp_path)
    assert {path.name for path in inner.iterdir()} == {"file", ".hidden"}
    assert (inner / "file").read_bytes() == b"old"


def test_data_is_on_disk_before_the_name_points_to_it(tmp_path, monkeypatch):
    order = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda f: (order.append("fsync"), fsync(f)))
    monkeypatch.setattr(os, "replace", lambda *a: (order.append("replace"), replace(*a)))
    storage.write_bytes(tmp_path / "file", b"data")
    assert order == ["fsync", "replace", "fsync"]  # the file, its name, the folder


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(StorageError, match="nowhere/file: cannot be written"):
        storage.write_bytes(tmp_path / "nowhere" / "file", b"data")
    assert names(tmp_path) == []


@pytest.mark.skipif(as_root, reason="root may write anywhere")
def test_a_folder_without_permission_is_named(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(StorageError, match="Permission denied"):
        storage.write_bytes(tmp_path / "file", b"data")
    with pytest.raises(StorageError, match=r"out is .*cannot be"):
        storage.new_folder(tmp_path / "new")
    with pytest.raises(StorageError, match=r"out is .*cannot be written"):
        storage.new_folder(tmp_path)
    tmp_path.chmod(0o700)


class Point(NamedTuple):
    x: float
    y: float


@pytest.mark.parametrize(
    ("value", "read"),
    [
        (float("nan"), None),
        (float("inf"), "inf"),
        (-float("inf"), "-inf"),
        (np.float32("nan"), None),
        (np.float64("inf"), "inf"),
        (np.int32(3), 3),
        (np.bool_(True), True),
        (np.asarray([1.5, np.nan]), [1.5, None]),
        (jnp.asarray([[1, 2]]), [[1, 2]]),
        (jnp.asarray(-jnp.inf), "-inf"),
        (Path("a") / "b", "a/b"),
        ((1, (2.5, "x")), [1, [2.5, "x"]]),
        (Point(1.0, float("nan")), [1.0, None]),
        ({3: {"a": float("inf")}}, {"3": {"a": "inf"}}),
        (None, None),
        (False, False),
    ],
)
def test_json_is_strict_whatever_is_written(value, read, tmp_path):
    path = tmp_path / "value.json"
    storage.write_json(path, {"value": value})
    text = path.read_text()
    assert text.endswith("}\n")
    strict = json.loads(text, parse_constant=lambda name: pytest.fail(name))
    assert strict == {"value": read}
    assert type(strict["value"]) is type(read)


def test_what_is_not_json_leaves_the_old_file(tmp_path):
    path = tmp_path / "value.json"
    storage.write_json(path, 1)
    with pytest.raises(TypeError):
        storage.write_json(path, {"value": object()})
    assert path.read_text() == "1\n"
    assert names(tmp_path) == ["value.json"]


def test_a_new_folder_is_made_with_its_parents(tmp_path):
    folder = storage.new_folder(tmp_path / "a" / "b")
    assert folder.is_dir()
    assert storage.new_folder(folder) == folder  # empty: still new
    assert storage.new_folder(str(tmp_path / "c")) == tmp_path / "c"


def test_a_folder_with_anything_in_it_is_refused(tmp_path):
    (tmp_path / ".hidden").touch()
    with pytest.raises(StorageError, match=r"out is .* must be a new or an empty folder"):
        storage.new_folder(tmp_path)
    with pytest.raises(StorageError, match=r"out is .* must be a new or an empty folder"):
        storage.new_folder(tmp_path / ".hidden")


def test_a_folder_under_a_file_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match=r"out is .*it cannot be created \(Not a directory\)"):
        storage.new_folder(tmp_path / "file" / "folder")


@pytest.mark.parametrize("name", ["x" * 300, "a\0b"])
def test_an_impossible_name_is_refused(name, tmp_path):
    with pytest.raises(ValueError, match=r"cannot be created|null byte"):
        storage.new_folder(tmp_path / name)


TREE = {
    "a": [jnp.asarray([[1.5, -0.0, jnp.nan]]), jnp.asarray(7, jnp.int32)],
    "b": Point(jnp.asarray([], jnp.float32), jnp.asarray([True, False])),
    "bytes": jnp.arange(256, dtype=jnp.uint8),
}


def test_a_tree_comes_back_bit_by_bit(tmp_path):
    storage.save(tmp_path / "new" / "folder", "thing", TREE, {"note": 1})
    like = jax.tree.map(jnp.zeros_like, TREE)
    found = storage.load(tmp_path / "new" / "folder", "thing", like)
    assert jax.tree.structure(found) == jax.tree.structure(TREE)
    for have, want in zip(jax.tree.leaves(found), jax.tree.leaves(TREE), strict=True):
        assert have.dtype == want.dtype
        assert have.shape == want.shape
        assert np.asarray(have).tobytes() == np.asarray(want).tobytes()
    assert storage.read_manifest(tmp_path / "new" / "folder", "thing")["about"] == {"note": 1}


def test_saving_again_replaces(tmp_path):
    storage.save(tmp_path, "thing", TREE, {})
    storage.save(tmp_path, "thing", {"a": jnp.ones(2)}, {})
    np.testing.assert_array_equal(storage.load(tmp_path, "thing", {"a": jnp.zeros(2)})["a"], 1)
    assert names(tmp_path) == [arrays_of(tmp_path).name, "manifest.json"]


def test_leaves_are_named_by_their_paths():
    assert set(storage.leaves(TREE)) == {"a/0", "a/1", "b/x", "b/y", "bytes"}


@pytest.mark.parametrize(
    ("like", "message"),
    [
        ({"a": jnp.zeros(3)}, r"a is float32\[2\]; it must be float32\[3\]"),
        ({"a": jnp.zeros(2, jnp.int32)}, r"a is float32\[2\]; it must be int32\[2\]"),
        ({"a": jnp.zeros(2), "b": jnp.zeros(2)}, "missing or too many: b"),
        ({}, "missing or too many: a"),
    ],
)
def test_another_shape_type_or_name_is_refused(like, message, tmp_path):
    storage.save(tmp_path, "thing", {"a": jnp.ones(2)}, {})
    with pytest.raises(StorageError, match=message):
        storage.load(tmp_path, "thing", like)


def test_another_kind_is_refused(tmp_path):
    storage.save(tmp_path, "thing", {"a": jnp.ones(2)}, {})
    with pytest.raises(StorageError, match="kind is 'thing'; it must be 'threat function'"):
        storage.load(tmp_path, "threat function", {"a": jnp.ones(2)})


SMALL = {"a": jnp.asarray([1.5, -2.0]), "key": jax.random.key(7)}


def bits(tree):
    return {name: a.tobytes() for name, a in storage.leaves(tree).items()}


def damaged_or_right(folder):
    """Loads what may be damaged: never anything but what was saved."""
    try:
        found = storage.load(folder, "thing", SMALL)
        about = storage.read_manifest(folder, "thing")["about"]
    except StorageError:
        return False
    assert bits(found) == bits(SMALL)
    assert about == {"x": 0.25, "note": "here"}
    return True


def saved_small(folder):
    storage.save(folder, "thing", SMALL, {"x": 0.25, "note": "here"})
    assert damaged_or_right(folder)
    return [arrays_of(folder), folder / "manifest.json"]


def test_every_flipped_bit_is_found(tmp_path):
    for path in saved_small(tmp_path):
        good, unseen = path.read_bytes(), 0
        for i in range(8 * len(good)):
            flipped = bytearray(good)
            flipped[i // 8] ^= 1 << i % 8
            path.write_bytes(flipped)
            unseen += damaged_or_right(tmp_path)
        assert unseen <= good.count(b"\n") * (path.suffix == ".json")  # space for space
        path.write_bytes(good)
        assert damaged_or_right(tmp_path)


def test_every_length_but_the_right_one_is_found(tmp_path):
    for path in saved_small(tmp_path):
        good = path.read_bytes()
        for length in [*range(len(good)), len(good) + 1]:
            path.write_bytes((good + b"x")[:length])
            if damaged_or_right(tmp_path):  # the line's end after the manifest
                assert (path.suffix, length) == (".json", len(good) - 1)
        path.write_bytes(good)


def test_nothing_is_read_for_a_forged_size(tmp_path, monkeypatch):
    _, path = saved_small(tmp_path)
    manifest = json.loads(path.read_text())
    monkeypatch.setattr(Path, "read_bytes", lambda *_: pytest.fail("it was read"))
    for shape in ([10**12], [2**62, 8], [-1], [2, 10**9], "2", None, [1.5]):
        forged = json.loads(json.dumps(manifest))
        forged["arrays"]["a"]["shape"] = shape
        path.write_text(json.dumps({**forged, "seal": storage.manifest_checksum(forged)}))
        with pytest.raises(StorageError, match=r"a is .*; it must be"):
            storage.load(tmp_path, "thing", SMALL)
    for change in ({"bytes": 10**15}, {"bytes": None}, {"sha256": "../../x"}, {"sha256": 3}):
        forged = {**manifest, **change}
        path.write_text(json.dumps({**forged, "seal": storage.manifest_checksum(forged)}))
        with pytest.raises(StorageError, match="cannot be right"):
            storage.load(tmp_path, "thing", SMALL)


@pytest.mark.parametrize("keep", [0, 1, -1])
def test_a_cut_file_is_found(keep, tmp_path):
    storage.save(tmp_path, "thing", {"a": jnp.ones(2)}, {})
    path = arrays_of(tmp_path)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(StorageError, match=r"arrays-\w+\.bin: \d+ bytes; the manifest says \d+"):
        storage.load(tmp_path, "thing", {"a": jnp.ones(2)})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cannot be read"),
        ("{", "cannot be read"),
        ("[]", "format is not 2"),
        ("null", "format is not 2"),
        ('{"format": 1}', "format is not 2"),
        ('{"format": 2}', "kind is None"),
        ('{"format": 2, "kind": "thing"}', "'about' and 'arrays' must be tables"),
        ('{"format": 2, "kind": "thing", "about": {}, "arrays": []}', "must be tables"),
        ('{"format": 2, "kind": "thing", "about": {}, "arrays": {}}', "differs from its seal"),
        ("[" * 100_000, "cannot be read"),
        (b"\xff\xfe", "cannot be read"),
    ],
)
def test_a_damaged_manifest_is_named(text, message, tmp_path):
    storage.save(tmp_path, "thing", {"a": jnp.ones(2)}, {})
    (tmp_path / "manifest.json").write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(StorageError, match=message):
        storage.load(tmp_path, "thing", {"a": jnp.ones(2)})


def test_missing_files_are_named(tmp_path):
    with pytest.raises(StorageError, match=r"no manifest\.json; it is not a saved thing"):
        storage.load(tmp_path / "nowhere", "thing", {})
    storage.save(tmp_path, "thing", {"a": jnp.ones(2)}, {})
    arrays_of(tmp_path).unlink()
    with pytest.raises(StorageError, match=r"arrays-\w+\.bin: cannot be read"):
        storage.load(tmp_path, "thing", {"a": jnp.ones(2)})
    (tmp_path / "manifest.json").unlink()
    (tmp_path / "manifest.json").mkdir()
    with pytest.raises(StorageError, match=r"manifest\.json: cannot be read"):
        storage.load(tmp_path, "thing", {"a": jnp.ones(2)})


def test_a_failed_save_leaves_the_old_one_whole(tmp_path, monkeypatch):
    storage.save(tmp_path, "thing", {"a": jnp.ones(2)}, {})
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", fail)
        with pytest.raises(StorageError):
            storage.save(tmp_path, "thing", {"a": jnp.zeros(2)}, {})
    np.testing.assert_array_equal(storage.load(tmp_path, "thing", {"a": jnp.zeros(2)})["a"], 1)


@pytest.mark.parametrize("name", ["open", "fdopen", "fsync", "chmod", "replace"])
def test_whatever_call_fails_the_old_one_or_the_new_one_is_whole(name, tmp_path, monkeypatch):
    folder = tmp_path / "thing"
    saved_small(folder)
    new = {"a": jnp.zeros(9)}
    for n in range(1, 10):
        saved_small(folder)
        with monkeypatch.context() as patch:
            patch.setattr(os, name, fails_at(n, getattr(os, name)))
            try:
                storage.save(folder, "thing", new, {})
                break  # it calls it less often than that
            except StorageError as error:
                said = str(error)
        assert "No space left on device" in said
        if not damaged_or_right(folder):
            assert bits(storage.load(folder, "thing", new)) == bits(new)
    assert n > 1


@pytest.mark.parametrize("call", ["write", "flush"])
def test_a_disk_that_fills_up_while_a_file_is_written_leaves_the_old_one(
    call, tmp_path, monkeypatch
):
    """Where a full disk shows most often: half of the bytes are there."""
    folder, opened, fdopen = tmp_path / "thing", 0, os.fdopen
    saved_small(folder)

    def half(*args, **kwargs):
        nonlocal opened
        opened += 1
        file = fdopen(*args, **kwargs)
        return Full(file, call) if opened == filled else file

    for filled in (1, 2):  # the arrays, the manifest
        opened = 0
        with monkeypatch.context() as patch:
            patch.setattr(os, "fdopen", half)
            with pytest.raises(StorageError, match="No space left on device"):
                storage.save(folder, "thing", {"a": jnp.zeros(9)}, {})
        assert opened == filled
        assert damaged_or_right(folder)
        assert not list(folder.glob(".*"))


class Full:
    """A file on a full disk."""

    def __init__(self, file, call):
        self.file, self.call = file, call

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.file.close()

    def __getattr__(self, name):
        return getattr(self.file, name)

    def write(self, data):
        if self.call == "write":
            self.file.write(bytes(data)[: len(data) // 2])
            fail()
        return self.file.write(data)

    def flush(self):
        if self.call == "flush":
            fail()
        self.file.flush()


def fails_at(n, operation):
    count = 0

    def call(*args, **kwargs):
        nonlocal count
        count += 1
        return fail() if count == n else operation(*args, **kwargs)

    return call


def test_keys_and_numpys_arrays_come_back_as_such(tmp_path):
    tree = {"key": jax.random.split(jax.random.key(1), 3), "a": np.arange(3.0), "b": jnp.ones(2)}
    storage.save(tmp_path, "thing", tree, {})
    found = storage.load(tmp_path, "thing", tree)
    assert found["key"].dtype == tree["key"].dtype
    assert bits(found) == bits(tree)
    assert isinstance(found["a"], np.ndarray)
    found["a"][0] = 7.0  # it is one's own
    shapes = {**tree, "b": jax.ShapeDtypeStruct((2,), jnp.float32)}
    assert bits(storage.load(tmp_path, "thing", shapes)) == bits(tree)


HOLD = "import fcntl, sys; f = open(sys.argv[1], 'w'); fcntl.flock(f, 2); print('held'); input()"


def test_one_process_works_in_a_folder_until_it_ends_however_it_ends(tmp_path):
    command = [sys.executable, "-u", "-c", HOLD, str(tmp_path / "lock")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(StorageError, match="another process is at work") as found:  # noqa: SIM117
            with storage.locked(tmp_path, "lock"):
                pytest.fail("two are inside")
        assert str(tmp_path) in str(found.value)
        other.kill()
        other.wait()
    for _ in range(2):
        with storage.locked(tmp_path, "lock"):
            pass


def test_a_lock_that_was_removed_before_it_was_got_is_none(tmp_path, monkeypatch):
    monkeypatch.setattr(storage.fcntl, "flock", lambda *_: (tmp_path / "lock").unlink())
    with pytest.raises(StorageError, match="has just finished"), storage.locked(tmp_path, "lock"):
        pytest.fail("it is inside")
    with pytest.raises(StorageError, match="cannot be written"):
        storage.locked(tmp_path / "nowhere", "lock").__enter__()


def test_a_file_system_without_locks_is_worked_on_without_them(tmp_path, monkeypatch):
    monkeypatch.setattr(storage.fcntl, "flock", fail)
    with storage.locked(tmp_path, "lock"):
        pass


def test_plain_numbers_are_kept_as_jax_takes_them(tmp_path):
    plain, arrays = {"a": 0.1, "n": 3, "yes": True}, {"a": 0.0, "n": 0, "yes": False}
    arrays = jax.tree.map(jnp.asarray, arrays)
    for saved in (plain, jax.tree.map(jnp.asarray, plain)):
        storage.save(tmp_path, "thing", saved, {})
        for like in (plain, arrays):
            found = storage.load(tmp_path, "thing", like)
            assert {name: a.dtype for name, a in found.items()} == {
                name: a.dtype for name, a in arrays.items()
            }
            np.testing.assert_array_equal(found["a"], jnp.asarray(0.1))
    assert storage.leaves(plain)["a"].dtype == jnp.asarray(0.1).dtype


class Sized:
    """An object whose usual text says where it is in memory."""

    def __init__(self, size):
        self.size = size

    def grown(self):
        return self.size + 1


class Slotted:
    __slots__ = ("size",)

    def __init__(self, size):
        self.size = size


def adder(n):
    return lambda value: value + n


def ringed(size):
    one = Sized(size)
    one.self = one
    return one


@pytest.mark.parametrize(
    "make",
    [
        lambda n: n,
        lambda n: ("front", n),
        lambda n: {"a": [n, None]},
        lambda n: frozenset({"a", "b", n}),
        lambda n: np.arange(3000) + n * (np.arange(3000) == 1500),
        Sized,
        Slotted,
        ringed,
        lambda n: Sized(Sized(n)),
        lambda n: Sized(n).grown,
        lambda n: functools.partial(adder, n),
        lambda n: functools.partial((adder, ringed)[n]),
        adder,
        lambda n: {"law": adder(n)},
        lambda n: jax.jit(adder(n)),
        lambda n: lambda a, b=n: a + b,
        lambda n: (lambda a: a + 1) if n else (lambda a: a - 1),
        lambda n: (lambda a: a + 2) if n else (lambda a: a + 3),
    ],
)
def test_static_values_have_one_text_each(make):
    zero, again, one = make(0), make(0), make(1)
    assert storage.text(zero) == storage.text(again) != storage.text(one)
    assert " at 0x" not in storage.text(zero)


def test_texts_of_earlier_files_stay_and_what_is_unknown_equals_itself_alone():
    for value in (3, 0.25, "released", ("front", 2), (1,), [1, 2], {"a": (1, 2)}, None, True):
        assert storage.text(value) == str(value)
    assert storage.text(jax) == "jax"
    thing, other = object(), object()
    assert storage.text(thing) == storage.text(thing) != storage.text(other)


def test_texts_are_those_of_other_processes():
    code = (
        "from rp_jax import storage; from rp_jax.envs import jam; "
        "print(storage.text((jam.step, frozenset({'a', 'b', 'c'}), jam)))"
    )
    texts = {
        subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            check=True,
        ).stdout
        for seed in ("1", "2", "3")
    }
    assert len(texts) == 1


def test_numpy_scalars_come_back_with_their_type(tmp_path):
    tree = {"a": np.float64(0.1), "b": np.int32(3), "c": 0.5}
    storage.save(tmp_path, "kind", tree, {})
    found = storage.load(tmp_path, "kind", tree)
    assert storage.checksum(found) == storage.checksum(tree)
    assert found["a"] == np.float64(0.1)


AMBIGUOUS = [
    {"a/b": jnp.ones(2), "a": {"b": jnp.zeros(2)}},
    {"a~1b": jnp.ones(2), "a/b": jnp.zeros(2), "a": {"b": jnp.full(2, 2.0)}},
    {"a~b": jnp.ones(2), "a~0b": jnp.zeros(2)},
    {"": {"": jnp.ones(2)}, "/": jnp.zeros(2), "a": {"": jnp.full(2, 2.0), "/": jnp.full(2, 3.0)}},
    {"a": [jnp.ones(2), jnp.zeros(2)], "a/0": jnp.full(2, 2.0)},
    {"a.b": jnp.ones(2), "a": {".b": jnp.zeros(2)}, "a\\b": jnp.full(2, 2.0)},
    {"A": jnp.ones(2), "a": jnp.zeros(2)},
    {"\u00e9": jnp.ones(2), "e\u0301": jnp.zeros(2)},  # one letter, written in two ways
    {1: {2: jnp.ones(2)}, 12: jnp.zeros(2)},
    {(0, 1): jnp.ones(2), (1, 0): jnp.zeros(2)},
]


@pytest.mark.parametrize("tree", AMBIGUOUS, ids=lambda tree: " ".join(map(repr, tree)))
def test_arrays_are_kept_apart_whatever_their_keys(tree, tmp_path):
    storage.save(tmp_path, "thing", tree, {})
    found = storage.load(tmp_path, "thing", jax.tree.map(jnp.zeros_like, tree))
    assert jax.tree.structure(found) == jax.tree.structure(tree)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), found, tree))
    assert len(storage.leaves(tree)) == len(jax.tree.leaves(tree))


class Named:
    """A key that is ordered, but has the text of every other one."""

    def __init__(self, number):
        self.number = number

    def __lt__(self, other):
        return self.number < other.number

    def __repr__(self):
        return "named"


def test_keys_of_one_text_are_refused_by_it(tmp_path):
    tree = {Named(1): jnp.ones(2), Named(2): jnp.zeros(2)}
    with pytest.raises(ValueError, match="'named' is there 2 times; each must be there once"):
        storage.save(tmp_path / "new", "thing", tree, {})
    with pytest.raises(ValueError, match="keys of a table: '1' is there 2 times"):
        storage.plain({"about": {1: "one", "1": "another"}})


def test_static_fields_are_kept_apart_whatever_the_keys():
    class Part(struct.PyTreeNode):
        size: int = struct.field(pytree_node=False)

    found = storage.statics({"a/b": Part(1), "a": {"b": Part(2)}})
    assert found == {"a~1b/size": 1, "a/b/size": 2}
    with pytest.raises(ValueError, match="'1' is there 2 times"):
        storage.statics({1: Part(1), "1": Part(2)})


def test_every_text_has_a_file_name_of_its_own():
    texts = [
        *("slip 0.1", "n=8", "a", "A", "a/b", "a:b", "a_b", "a b", "a\\b", "../a", "..", ".", ""),
        *(
            " a",
            "a ",
            "a.",
            ".a",
            "00000001",
            "\u00e9",
            "e\u0301",
            "N=8",
            "x" * 300,
            "x" * 301,
            "~",
        ),
        *("a\0b", "a\nb", "\ud800", storage.file_name("A")),
    ]
    names = [storage.file_name(text) for text in texts]
    assert names[:3] == texts[:3]  # plain ones are their own names
    folded = {unicodedata.normalize("NFC", name).casefold() for name in names}
    assert len(folded) == len(texts)
    for name in names:
        assert re.fullmatch(r"[A-Za-z0-9=_~][A-Za-z0-9=_. ~-]*", name), name
        assert len(name) < 120
        assert not name.isdecimal()
        assert not name.endswith((" ", "."))


NUMBERS = {"a": jnp.asarray([1.5, jnp.nan]), "n": jnp.asarray([7], jnp.int32)}


def test_numbers_of_another_precision_are_converted_and_said_so(tmp_path):
    storage.save(tmp_path / "single", "thing", NUMBERS, {})
    with jax.enable_x64(True):
        double = {"a": jnp.asarray([1 / 3, jnp.inf]), "n": jnp.asarray([-7], jnp.int64)}
        storage.save(tmp_path / "double", "thing", double, {})
        says = r"a is float32\[2\], saved with jax_enable_x64=False; here it is float64\[2\], with "
        with pytest.warns(storage.PrecisionWarning, match=says + "jax_enable_x64=True"):
            found = storage.load(tmp_path / "single", "thing", double, convert=True)
        assert (found["a"].dtype, found["n"].dtype) == (np.float64, np.int64)
        np.testing.assert_array_equal(found["a"], [1.5, np.nan])
    says = r"a is float64\[2\], saved with jax_enable_x64=True; here it is float32"
    with pytest.warns(storage.PrecisionWarning, match=says):
        found = storage.load(tmp_path / "double", "thing", NUMBERS, convert=True)
    assert (found["a"].dtype, found["n"].dtype) == (np.float32, np.int32)
    np.testing.assert_array_equal(found["a"], np.asarray([1 / 3, np.inf], np.float32))
    assert found["n"] == -7


def test_numbers_of_another_precision_are_refused_where_they_must_be_the_same_bits(tmp_path):
    storage.save(tmp_path, "thing", NUMBERS, {})
    with jax.enable_x64(True):
        like = {"a": jnp.zeros(2), "n": jnp.zeros(1, jnp.int32)}
        with pytest.raises(storage.PrecisionError, match="saved with jax_enable_x64=False; here"):
            storage.load(tmp_path, "thing", like)
        like = {"a": jnp.zeros(3), "n": jnp.zeros(1, jnp.int32)}
        with pytest.raises(StorageError, match=r"a is float32\[2\]; it must be float64\[3\]"):
            storage.load(tmp_path, "thing", like, convert=True)


@pytest.mark.parametrize(("large", "dtype"), [(2**40, "int32"), (1e300, "float32")])
def test_what_is_too_large_for_single_precision_is_named(large, dtype, tmp_path):
    with jax.enable_x64(True):
        storage.save(tmp_path, "thing", {"a": jnp.asarray([large])}, {})
    says = f"a is {dtype[:-2]}64; a number in it is too large for {dtype}"
    with pytest.raises(storage.PrecisionError, match=says):
        storage.load(tmp_path, "thing", {"a": jnp.zeros(1, dtype)}, convert=True)
