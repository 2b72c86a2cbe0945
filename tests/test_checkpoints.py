import errno
import os
import shutil
import signal
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax import checkpoints, storage
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.storage import StorageError

LENGTH = 5


class Carried(NamedTuple):
    key: jax.Array
    total: jax.Array
    record: np.ndarray


def blank():
    return Carried(jax.random.key(3), jnp.zeros(2), np.zeros(LENGTH, np.float32))


def step(i, carried):
    key, draw = jax.random.split(carried.key)
    total = carried.total + jax.random.normal(draw, (2,))
    carried.record[i] = total[0]
    return Carried(key, total, carried.record)


def result(carried):
    return {"total": carried.total, "record": carried.record}


def bits(tree):
    return {name: a.tobytes() for name, a in storage.leaves(tree).items()}


WANTED = bits(NO_CHECKPOINTS.loop(blank(), step, LENGTH, result))


@pytest.fixture
def said():
    return []


@pytest.fixture
def kept(tmp_path, monkeypatch, said):
    """Checkpoints after every step."""
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    monkeypatch.setattr(checkpoints, "SHARE", float("inf"))
    return Checkpoints(tmp_path / "loop", run="settings", name="loop", say=said.append)


class StopError(Exception):
    pass


def stop_at(n):
    def stopping(i, carried):
        if i == n:
            raise StopError
        return step(i, carried)

    return stopping


def stopped(kept, n):
    with pytest.raises(StopError):
        kept.loop(blank(), stop_at(n), LENGTH, result)


def resumed(kept):
    return bits(kept.loop(blank(), step, LENGTH, result))


@pytest.mark.parametrize("n", range(LENGTH))
def test_a_loop_goes_on_where_it_was(n, kept, said):
    stopped(kept, n)
    seen = []
    found = kept.loop(blank(), lambda i, s: (seen.append(i), step(i, s))[1], LENGTH, result)
    assert bits(found) == WANTED
    assert seen == list(range(n, LENGTH))
    assert said == ([f"loop: {n} of {LENGTH} were done"] if n else [])


def test_what_is_finished_is_not_done_again(kept):
    assert resumed(kept) == WANTED
    found = kept.loop(blank(), stop_at(0), LENGTH, result)
    assert bits(found) == WANTED
    assert isinstance(found["record"], np.ndarray)
    assert isinstance(found["total"], jax.Array)


def test_the_last_two_are_kept(kept):
    stopped(kept, 4)
    assert sorted(path.name for path in kept.folder.iterdir()) == ["00000003", "00000004"]


def test_checkpoints_are_written_after_a_while_and_at_the_end(kept, monkeypatch):
    monkeypatch.setattr(checkpoints, "INTERVAL", 3600.0)
    stopped(kept, 4)
    assert not kept.folder.exists()
    assert resumed(kept) == WANTED
    assert [path.name for path in kept.folder.iterdir()] == ["00000005"]


def test_a_slow_disk_gets_few_checkpoints(kept, monkeypatch):
    monkeypatch.setattr(checkpoints, "SHARE", 1e-9)
    stopped(kept, 4)
    assert [path.name for path in kept.folder.iterdir()] == ["00000001"]


def test_ctrl_c_finishes_the_step_and_says_where_it_is(kept, said, monkeypatch):
    monkeypatch.setattr(checkpoints, "INTERVAL", 3600.0)

    def interrupted(i, carried):
        if i == 3:
            signal.raise_signal(signal.SIGINT)
        return step(i, carried)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match="loop: 4 of 5 done"):
        kept.loop(blank(), interrupted, LENGTH, result)
    assert signal.getsignal(signal.SIGINT) is before
    assert said == ["interrupted: finishing this step; again stops at once"]
    assert resumed(kept) == WANTED
    assert said[-1] == "loop: 4 of 5 were done"


@pytest.fixture
def ctrl_c():
    """It interrupts, also where the tests run in the background of a shell, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_twice_stops_at_once(kept):
    def interrupted(i, carried):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("it went on")

    with pytest.raises(KeyboardInterrupt):
        kept.loop(blank(), interrupted, LENGTH, result)
    assert resumed(kept) == WANTED


def files(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize("how", ["flip", "cut", "gone"])
def test_from_a_damaged_one_it_goes_back_loudly(how, kept, said, tmp_path):
    stopped(kept, 4)
    whole = tmp_path / "whole"
    shutil.copytree(kept.folder, whole)
    for damaged in files(kept.folder / "00000004"):
        data = damaged.read_bytes()
        middle = len(data) // 2
        flipped = bytes([data[middle] ^ 4]) + data[middle + 1 :]
        damaged.write_bytes(data[:middle] + (flipped if how == "flip" else b""))
        if how == "gone":
            damaged.unlink()
        said.clear()
        assert resumed(kept) == WANTED
        assert said[0].startswith("warning: ")
        assert str(kept.folder / "00000004") in said[0]
        assert said[1] == "loop: 3 of 5 were done"
        shutil.rmtree(kept.folder)
        shutil.copytree(whole, kept.folder)


def test_where_none_is_whole_it_begins_anew(kept, said):
    stopped(kept, 4)
    for path in files(kept.folder):
        path.write_bytes(b"")
    assert resumed(kept) == WANTED
    assert len(said) == 2
    assert all(line.startswith("warning: ") for line in said)


def test_those_of_other_settings_are_refused(kept):
    stopped(kept, 4)
    other = Checkpoints(kept.folder, run="others")
    with pytest.raises(StorageError, match="not of a run with these settings"):
        other.loop(blank(), step, LENGTH, result)
    with pytest.raises(StorageError, match="not of a run with these settings"):
        kept.loop(blank(), step, LENGTH + 1, result)


def test_parts_have_folders_of_their_own(tmp_path):
    part = Checkpoints(tmp_path, run="r").at("threat").at("wall")
    assert (part.folder, part.name, part.run) == (tmp_path / "threat" / "wall", "threat wall", "r")
    assert NO_CHECKPOINTS.at("threat") is NO_CHECKPOINTS


def test_all_are_removed_in_the_end(kept):
    resumed(kept)
    kept.clear()
    assert not kept.folder.exists()
    NO_CHECKPOINTS.clear()


OPERATIONS = ("open", "fsync", "chmod", "replace", "mkdir", "unlink", "rmdir", "fdopen")


class Disk:
    """Counts operations on files; from the n-th on, each of them fails or the process is dead."""

    def __init__(self, monkeypatch, n, error):
        self.count = 0
        for name in OPERATIONS:
            monkeypatch.setattr(os, name, self.wrapped(getattr(os, name), n, error))

    def wrapped(self, operation, n, error):
        def call(*args, **kwargs):
            self.count += 1
            if n is not None and self.count >= n:
                raise error
            return operation(*args, **kwargs)

        return call


class Killed(BaseException):
    """Nothing after it reaches the disk."""


def operations(kept):
    with pytest.MonkeyPatch.context() as patch:
        disk = Disk(patch, None, None)
        resumed(kept)
    shutil.rmtree(kept.folder)
    return disk.count


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        OSError(errno.EROFS, "Read-only file system"),
        Killed(),
    ],
    ids=["full", "read-only", "killed"],
)
def test_whatever_operation_fails_nothing_is_lost(error, kept):
    count, told = operations(kept), []
    assert count > 40
    for n in range(1, count + 1):
        with pytest.MonkeyPatch.context() as patch:
            Disk(patch, n, error)
            try:
                assert resumed(kept) == WANTED  # only the tidying failed
            except (StorageError, Killed) as found:
                told.append(str(found))
        if isinstance(error, OSError):
            assert all(str(error.strerror) in line for line in told)
        assert resumed(kept) == WANTED
        shutil.rmtree(kept.folder)


def test_a_loop_of_another_precision_is_not_begun_anew(tmp_path, monkeypatch):
    monkeypatch.setattr("rp_jax.checkpoints.INTERVAL", 0.0)
    here = Checkpoints(tmp_path, name="counting", say=lambda text: pytest.fail(text))
    with pytest.raises(FloatingPointError):
        here.loop(jnp.zeros(2), half_way, 4)
    with jax.enable_x64(True):
        says = "saved with jax_enable_x64=False; here it is .* go on with that setting"
        with pytest.raises(storage.PrecisionError, match=says):
            here.loop(jnp.zeros(2), half_way, 4)


def half_way(i, state):
    if i == 2:
        raise FloatingPointError
    return state + 1


def test_parts_of_the_work_have_folders_of_their_own_whatever_their_names(tmp_path):
    here = Checkpoints(tmp_path / "job")
    names = ["a/b", "a:b", "A", "a", "..", "00000003", ""]
    folders = [here.at(name).folder for name in names]
    assert len({str(folder).casefold() for folder in folders}) == len(names)
    assert all(folder.parent == tmp_path / "job" for folder in folders)
    assert not any(folder.name.isdecimal() for folder in folders)
