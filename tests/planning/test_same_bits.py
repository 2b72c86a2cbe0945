"""Same seed, same bits: across runs, chunk lengths, and one or four devices of the host."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

DEVICES = "--xla_force_host_platform_device_count"


def digests():
    """Of the whole state after 8 iterations of the corridor, in chunks of 8, 2 and 8."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    import jax
    import probe

    from rp_jax import storage
    from rp_jax.planning import loop
    from rp_jax.planning.loop import LoopConfig

    jax.config.update("jax_disable_most_optimizations", True)
    config = LoopConfig(steps=640, num_envs=16, batch=32, replay=512, replay_start=64)
    pmdp = probe.make_pmdp(probe, probe.make_params())
    init = jax.jit(loop.init, static_argnums=2)
    chunk = jax.jit(loop.chunk, static_argnums=(2, 3))
    for length in (8, 2, 8):
        state, _ = init(jax.random.key(0), pmdp, config)
        for _ in range(8 // length):
            state, _ = chunk(state, pmdp, config, length)
        data = b"".join(a.tobytes() for a in storage.leaves(state).values())
        print(hashlib.sha256(data).hexdigest())


@pytest.mark.slow
def test_runs_chunks_and_devices_make_no_difference():
    found = []
    for devices in (1, 4):
        names = {**os.environ, "XLA_FLAGS": f"{DEVICES}={devices}"}
        done = subprocess.run(
            [sys.executable, __file__], env=names, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        found += done.stdout.split()
    assert len(found) == 6
    assert len(set(found)) == 1


if __name__ == "__main__":
    digests()
