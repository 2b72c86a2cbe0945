"""The checksum of what computes a job."""

import importlib
import shutil
import sys
import types
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import pytest
from flax import struct

import rp_jax
from rp_jax.envs import jam
from rp_jax.planning.conditioned import Conditioned
from rp_jax.runs import record


class Part(struct.PyTreeNode):
    """Something with static fields."""

    rows: Any
    horizon: int = struct.field(pytree_node=False)
    model: Any = struct.field(pytree_node=False)


@pytest.fixture
def library():
    return record.library_code.__wrapped__


@pytest.fixture
def odd_world(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    folder = tmp_path / "odd_world"
    files = {
        "__init__": "",
        "world": "import numpy\nfrom odd_world import moves\ndef reset(): from . import late",
        "moves": "from .deeper import thing",
        "late": "",
        "other": "",
        "deeper/__init__": "thing = 1",
    }
    (folder / "deeper").mkdir(parents=True)
    for name, text in files.items():
        (folder / f"{name}.py").write_text(text)
    yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "odd_world"]:
        del sys.modules[name]


def test_the_code_of_a_job_is_also_that_of_its_own_world_and_of_what_it_imports(odd_world):
    world = importlib.import_module("odd_world.world")
    names = {
        "odd_world": "__init__",
        "odd_world.world": "world",
        "odd_world.moves": "moves",
        "odd_world.late": "late",  # imported by a function that has not been called
        "odd_world.deeper": "deeper/__init__",
    }
    files = {name: odd_world / f"{file}.py" for name, file in names.items()}
    assert record.sources_of(world) == files
    before = record.code_of(world)
    assert set(before) == {"rp_jax", *files}
    (odd_world / "other.py").write_text("x = 2")  # which is not imported
    assert record.code_of(world) == before
    for name in ("odd_world.deeper", "odd_world.late", "odd_world.world"):
        files[name].write_text(f"{files[name].read_text()}\nthing = 2")
        after = record.code_of(world)
        assert {key for key in after if after[key] != before[key]} == {name}
        before = after
    files["odd_world.late"].write_text("def f(:")
    with pytest.raises(ValueError, match=r"late\.py cannot be parsed"):
        record.code_of(world)


def test_whatever_an_environment_is_its_source_is_found(odd_world):
    world = importlib.import_module("odd_world.world")
    wanted = record.sources_of(world)
    world.Room = type("Room", (), {"__module__": "odd_world.world"})
    ring = types.SimpleNamespace()
    ring.env, ring.reset = ring, world.reset
    for env in (
        Conditioned(world),  # a wrapper
        world.Room(),
        world.Room,
        types.SimpleNamespace(reset=world.reset, step=jam.step),
        ring,
    ):
        assert record.sources_of(env) == wanted


def test_a_world_without_a_package_has_the_modules_and_packages_beside_it(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "my_helpers").mkdir()
    for name, text in {
        "my_room": "import my_physics, json\nfrom my_helpers.sums import add",
        "my_physics": "",
        "notes": "",
        "my_helpers/__init__": "",
        "my_helpers/sums": "def add(): pass",
    }.items():
        (tmp_path / f"{name}.py").write_text(text)
    room = importlib.import_module("my_room")
    assert set(record.sources_of(room)) == {
        "my_room",
        "my_physics",
        "my_helpers",
        "my_helpers.sums",
    }
    for name in [name for name in sys.modules if name.startswith("my_")]:
        del sys.modules[name]


def test_worlds_of_the_library_have_no_code_of_their_own():
    assert record.sources_of(jam) == {}
    assert list(record.code_of(jam)) == ["rp_jax"]


def test_the_file_that_changed_is_named():
    found = {"code": {"rp_jax": "ab", "room.world": "cd"}}
    wanted = {"code": {"rp_jax": "ab", "room.world": "ef"}}
    says = r"code of room\.world has the checksum cd, that of here ef; it must be the same"
    with pytest.raises(ValueError, match=says):
        record.compared("folder is x", found, wanted)
    record.compared("folder is x", found, found)


def test_static_fields_count_wherever_they_are():
    def params(horizon, model):
        return {"a": (Part(jnp.ones(2), horizon, model), [1.0])}

    one = record.digest_of(params(5, jam.step))
    assert one == record.digest_of(params(5, jam.step))
    assert one != record.digest_of(params(6, jam.step))  # inside a table and a tuple
    assert one != record.digest_of(params(5, jam.reset))


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
