import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax import devices

ROOT = Path(__file__).parents[1]


def start(setting, **environment):
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "JAX_PLATFORMS": "cpu",
        **environment,
    }
    script = str(ROOT / "tests" / "spreading.py")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, script, setting], env=environment, **pipes)


def finish(process):
    out, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    return json.loads(out.splitlines()[-1])


def same_as_one_device(found):
    assert found["same_seeds"]  # to the last bit, in programs of as many seeds
    assert found["same_labels"]
    assert found["same_resumed"]


def test_four_devices_do_what_one_does():
    found = finish(start("all", XLA_FLAGS="--xla_force_host_platform_device_count=4"))
    assert (found["devices"], found["processes"]) == (4, 1)
    same_as_one_device(found)


@pytest.mark.slow
def test_two_processes_do_what_one_does():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{one.getsockname()[1]}"
    told = {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": "2"}
    both = [start("cluster", **told, JAX_PROCESS_ID=str(i)) for i in range(2)]
    first, second = map(finish, both)
    assert (first["devices"], first["processes"]) == (2, 2)
    assert first == second
    same_as_one_device(first)


def test_a_cluster_that_is_none_is_refused(monkeypatch):
    for name in list(os.environ):
        if name.startswith(("JAX_COORD", "JAX_NUM", "JAX_PROC", "SLURM", "OMPI", "KUBERNETES")):
            monkeypatch.delenv(name)
    with pytest.raises(ValueError, match="devices is 'cluster'; it must be started by"):
        devices.connect("cluster")
    with pytest.raises(ValueError, match="devices is 'cluster'; it must be started by"):
        devices.mesh_of("cluster")  # as of a call that was not told to connect before


def test_without_a_mesh_all_is_as_ever():
    assert devices.mesh_of("one") is None
    rows, scale = jnp.arange(3.0), jnp.asarray(2.0)
    assert devices.shard_arguments((rows, scale), (0, None), None) == (rows, scale)
    doubled = devices.sharded_vmap(lambda a, b: a * b, (0, None), None)(rows, scale)
    np.testing.assert_array_equal(devices.gather(doubled, None), [0, 2, 4])
    assert devices.sharded_shapes(rows, None) is rows
    assert devices.broadcast_first(rows) is rows
    assert devices.is_first()


def test_one_device_spread_is_one_device():
    mesh = devices.mesh_of("all")
    (rows,) = devices.shard_arguments((jnp.arange(4.0 * mesh.size),), (0,), mesh)
    tripled = devices.sharded_vmap(lambda a: 3 * a, (0,), mesh)(rows)
    np.testing.assert_array_equal(devices.gather(tripled, mesh), 3 * np.arange(4.0 * mesh.size))
    assert devices.sharded_shapes(rows, mesh).sharding.mesh == mesh


def test_rows_that_cannot_be_shared_out_are_named():
    class Three:
        size = 3

    devices.divides("seeds", 6, Three())
    devices.divides("seeds", 7, None)
    with pytest.raises(ValueError, match="seeds is 7; with 3 devices it must be a multiple of 3"):
        devices.divides("seeds", 7, Three())
