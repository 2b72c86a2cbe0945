"""What a job depends on, and what is said where that is not the same any more."""

import importlib
import json
import os
import subprocess
import sys

import jax
import pytest

from examples.trolley import world as trolley
from rp_jax.envs import jam
from rp_jax.runs import record

SETTINGS = {  # by name of a setting of jax.config, another value and the context that sets it
    "jax_threefry_partitionable": (False, jax.threefry_partitionable),
    "jax_enable_x64": (True, jax.enable_x64),
    "jax_default_matmul_precision": ("highest", jax.default_matmul_precision),
    "jax_default_prng_impl": ("rbg", jax.default_prng_impl),
    "jax_numpy_dtype_promotion": ("strict", jax.numpy_dtype_promotion),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_count_as_they_are_however_they_were_set(name):
    value, within = SETTINGS[name]
    before = record.flags()
    with within(value):
        inside = record.flags()
    assert {key for key in before if before[key] != inside[key]} == {name}
    assert inside[name] == str(value)
    usual = getattr(jax.config, name)
    try:
        jax.config.update(name, value)
        assert record.flags() == inside
    finally:
        jax.config.update(name, usual)
    assert record.flags() == before


def test_settings_of_the_environment_count():
    code = "import json; from rp_jax.runs import record; print(json.dumps(record.flags()))"
    given = {"JAX_THREEFRY_PARTITIONABLE": "0", "JAX_RANDOM_SEED_OFFSET": "3", "XLA_FLAGS": ""}
    given["NVIDIA_TF32_OVERRIDE"] = "0"
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | given, capture_output=True, check=True
    )
    found = json.loads(done.stdout)
    assert found["jax_threefry_partitionable"] == "False"
    assert found["jax_random_seed_offset"] == "3"
    assert found["NVIDIA_TF32_OVERRIDE"] == "0"
    assert found["XLA_FLAGS"] == ""


def test_every_setting_is_one_that_jax_has():
    assert "" not in {record.flags()[name] for name in record.CONFIG}


def test_a_job_goes_on_with_the_settings_that_it_was_begun_with(tmp_path):
    def go(fails=False):
        with record.job(tmp_path, "counting", record.machine(jam)):
            if fails:
                raise KeyboardInterrupt

    with jax.threefry_partitionable(False), pytest.raises(KeyboardInterrupt):
        go(fails=True)
    says = "its flags: jax_threefry_partitionable is False; it must be True"
    with pytest.raises(ValueError, match=says):
        go()
    with jax.threefry_partitionable(False):
        go()
    assert not (tmp_path / record.CHECKPOINTS).exists()


def test_the_versions_of_what_computes_count():
    usual = {"rp_jax", "jax", "jaxlib", "flax", "optax", "flashbax", "numpy", "scipy"}
    assert set(record.versions_of(jam)) == usual
    assert record.versions_of(jam)["jax"] == jax.__version__


def test_the_versions_of_a_world_s_own_packages_count(tmp_path, monkeypatch):
    """Brax is imported by the adapter that the trolley is built on."""
    assert set(record.versions_of(trolley)) == {*record.versions_of(jam), "brax"}
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "odd_room.py").write_text("import json, chex, rich")
    room = importlib.import_module("odd_room")
    assert set(record.versions_of(room)) == {*record.versions_of(jam), "chex"}
    del sys.modules["odd_room"]


def test_jobs_whose_names_differ_in_signs_alone_keep_apart(tmp_path):
    """Interrupted in the second test, the first one is done again and does not meet its files."""

    def go(name, fails=False):
        with record.job(tmp_path, f"evaluation {name}", {"test": name}):
            if fails:
                raise KeyboardInterrupt

    go("a/b")
    with pytest.raises(KeyboardInterrupt):
        go("a:b", fails=True)
    for name in ("a/b", "A:b", "a:b"):
        go(name)
    assert not (tmp_path / record.CHECKPOINTS).exists()


def test_a_checksum_that_differs_reminds_of_the_precision():
    found, wanted = {"params": 32 * "a"}, {"params": 32 * "b"}
    with pytest.raises(ValueError, match="precision: jax_enable_x64 is False here"):
        record.compared("folder is x", found, wanted)
