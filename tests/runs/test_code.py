"""The checksum of what computes a job."""

import shutil
from pathlib import Path

import pytest

import rp_jax
from rp_jax.envs import jam
from rp_jax.runs import record


@pytest.fixture
def code():
    return record.code_of.__wrapped__


def test_the_code_of_a_job_is_also_that_of_its_own_world(tmp_path, monkeypatch, code):
    monkeypatch.syspath_prepend(tmp_path)
    folder = tmp_path / "odd_world"
    folder.mkdir()
    for name in ("__init__.py", "world.py"):
        (folder / name).write_text("")
    import odd_world.world

    assert record.source_of(odd_world.world) == folder
    before = code(folder)
    assert before == code(folder)
    (folder / "world.py").write_text("GRAVITY = 2")
    assert code(folder) != before
    assert record.source_of(jam) is None
    assert code(None) == before  # its files were empty


def test_the_code_of_a_job_is_that_of_the_library_but_for_what_is_shown(
    tmp_path, monkeypatch, code
):
    copy = tmp_path / "plot" / "rp_jax"  # a checkout in a folder of that name
    shutil.copytree(Path(rp_jax.__file__).parent, copy)
    monkeypatch.setattr(rp_jax, "__file__", str(copy / "__init__.py"))
    before = code(None)
    for shown in ("plot/curves.py", "cli/terminal.py"):
        (copy / shown).write_text("")
    assert code(None) == before
    (copy / "threat" / "report.py").write_text("")
    assert code(None) != before
