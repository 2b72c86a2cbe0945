"""The checksum of what computes a job."""

import importlib
import shutil
import sys
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import pytest
from flax import struct

import rp_jax
from rp_jax import storage
from rp_jax.envs import jam
from rp_jax.planning.conditioned import Conditioned
from rp_jax.runs import record


class Part(struct.PyTreeNode):
    """Something with static fields."""

    rows: Any
    horizon: int = struct.field(pytree_node=False)
    model: Any = struct.field(pytree_node=False)


class Plain:
    """An object whose text says where it is in memory."""

    def __init__(self, size):
        self.size = size


@pytest.fixture
def library():
    return record.library_code.__wrapped__


@pytest.fixture
def odd_world(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    folder = tmp_path / "odd_world"
    folder.mkdir()
    files = {
        "__init__": "",
        "world": "import numpy\nfrom odd_world import moves\nfrom . import never\nGRAVITY = 1",
        "moves": "from .deeper import thing",
        "never": "",
        "other": "",
        "deeper/__init__": "thing = 1",
    }
    (folder / "deeper").mkdir()
    for name, text in files.items():
        (folder / f"{name}.py").write_text(text)
    yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "odd_world"]:
        del sys.modules[name]


def test_the_code_of_a_job_is_also_that_of_its_own_world_and_of_what_it_imports(odd_world):
    world = importlib.import_module("odd_world.world")
    names = ("__init__", "world", "moves", "never", "deeper/__init__")
    files = [odd_world / f"{name}.py" for name in names]
    assert record.sources_of(world) == sorted(files)
    before = record.code_of(world)
    assert before == record.code_of(world)
    assert len(before) == 1 + len(files)
    (odd_world / "other.py").write_text("x = 2")  # which is not imported
    assert record.code_of(world) == before
    for name in ("deeper/__init__", "world"):
        text = (odd_world / f"{name}.py").read_text()
        (odd_world / f"{name}.py").write_text(f"{text}\nthing = 2")
        after = record.code_of(world)
        assert {key for key in after if after[key] != before[key]} == {f"odd_world/{name}.py"}
        before = after


def test_a_wrapped_world_and_a_world_that_is_an_object_count_too(odd_world):
    world = importlib.import_module("odd_world.world")
    assert record.sources_of(Conditioned(world)) == record.sources_of(world)
    world.Room = type("Room", (), {"__module__": "odd_world.world"})
    assert record.sources_of(world.Room()) == record.sources_of(world)


def test_a_world_without_a_package_has_the_modules_beside_it(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "my_room.py").write_text("import my_physics, json")
    (tmp_path / "my_physics.py").write_text("")
    (tmp_path / "notes.py").write_text("")
    room = importlib.import_module("my_room")
    assert [file.name for file in record.sources_of(room)] == ["my_physics.py", "my_room.py"]
    for name in ("my_room", "my_physics"):
        del sys.modules[name]


def test_worlds_of_the_library_have_no_code_of_their_own():
    assert record.sources_of(jam) == []
    assert list(record.code_of(jam)) == ["rp_jax"]


def test_the_file_that_changed_is_named():
    found = {"code": {"rp_jax": "ab", "room/world.py": "cd"}}
    wanted = {"code": {"rp_jax": "ab", "room/world.py": "ef"}}
    says = r"code of room/world\.py has the checksum cd, that of here ef; it must be the same"
    with pytest.raises(ValueError, match=says):
        record.compared("folder is x", found, wanted)
    record.compared("folder is x", found, found)


def test_static_values_count_by_their_text_which_every_process_has_alike():
    def params(horizon, model):
        return {"a": (Part(jnp.ones(2), horizon, model), [1.0])}

    one = record.digest_of(params(5, jam.step))
    assert one == record.digest_of(params(5, jam.step))
    assert one != record.digest_of(params(6, jam.step))  # inside a table and a tuple
    assert one != record.digest_of(params(5, jam.reset))
    assert storage.text(jam.step) == "rp_jax.envs.jam.step"
    assert storage.text(Plain(3)) == storage.text(Plain(3)) != storage.text(Plain(4))
    assert storage.text((1, "a")) == "(1, a)"


def test_the_code_of_a_job_is_that_of_the_library_but_for_what_is_shown(
    tmp_path, monkeypatch, library
):
    copy = tmp_path / "plot" / "rp_jax"  # a checkout in a folder of that name
    shutil.copytree(Path(rp_jax.__file__).parent, copy)
    monkeypatch.setattr(rp_jax, "__file__", str(copy / "__init__.py"))
    before = library()
    for shown in ("plot/curves.py", "cli/terminal.py"):
        (copy / shown).write_text("")
    assert library() == before
    (copy / "threat" / "report.py").write_text("")
    assert library() != before
