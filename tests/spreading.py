"""Learning and labelling shared out over devices, beside the same on one device.

python tests/spreading.py SETTING prints what is equal, as JSON; started by test_devices.py.
"""

import json
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from quick import stopped_after

from rp_jax import devices
from rp_jax.planning import loop
from rp_jax.recon import labels, sampling
from rp_jax.runs.plan import plan

SEEDS = 4
LOOP = loop.LoopConfig(steps=200, num_envs=8, batch=16, replay=256, replay_start=32)


def learner(mesh):
    """From seeds to weights after some learning, leading axis (seeds,)."""
    pmdp = probe.make_pmdp(probe, probe.make_params())
    axes = (0, pmdp.replace(params=None, threats=None, x=0, penalty=None, insecure_penalty=None))

    def learn(key, pmdp):
        return loop.chunk(loop.init(key, pmdp, LOOP)[0], pmdp, LOOP, 20)[0].learner.params

    program = jax.jit(devices.sharded_vmap(learn, axes, mesh))

    def run(seeds):
        keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))
        given = devices.shard_arguments(
            (keys, pmdp.replace(x=jnp.full(len(seeds), 0.5))), axes, mesh
        )
        return jax.device_get(devices.gather(program(*given), mesh))

    return run


def labelled(mesh):
    """Threats of 101 states, which no number of devices divides."""
    (sub,) = probe.sub_rmdps(probe.make_params()).values()
    start = jax.vmap(sub.source.state_of)(sampling.uniform(jax.random.key(1), sub, 101))
    estimator = labels.best_estimator(sub.replace(source=sub.source.replace(static=False)), 8)
    return jax.device_get(labels.label(jax.random.key(2), *start, sub, estimator, mesh=mesh))


def resumed(folder):
    """Weights of a job that was interrupted half-way and resumed, and of one that was not."""

    def learn(name):
        key, params = jax.random.key(0), probe.make_params()
        settings = {"seeds": SEEDS, "config": LOOP, "devices": "all", "folder": folder / name}
        return plan(key, probe, params, **settings).weights

    with stopped_after(11, pytest.MonkeyPatch()), pytest.raises(KeyboardInterrupt):
        learn("apart")
    return learn("apart"), learn("at_once")


def equal(a, b):
    """Whether all bits of two pytrees are."""
    return all(jax.tree.leaves(jax.tree.map(np.array_equal, a, b)))


def main(setting):
    """Compares, and prints."""
    jax.config.update("jax_disable_most_optimizations", True)
    devices.connect(setting)
    mesh = devices.mesh_of(setting)
    each = SEEDS // mesh.size
    spread, alone = learner(mesh)(range(SEEDS)), learner(None)
    parts = [alone(range(i, i + each)) for i in range(0, SEEDS, each)]
    apart = jax.tree.map(lambda *rows: np.concatenate(rows), *parts)
    found = {
        "devices": mesh.size,
        "processes": jax.process_count(),
        "same_seeds": equal(spread, apart),
        "same_labels": equal(labelled(mesh), labelled(None)),
        "same_resumed": jax.process_count() > 1 or equal(*resumed(Path(tempfile.mkdtemp()))),
        "sum": float(sum(np.abs(a).sum() for a in jax.tree.leaves(spread))),
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1])
