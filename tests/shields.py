"""What is evaluated and recorded: the corridor under some threshold, and a shield at random."""

import functools

import jax.numpy as jnp
import numpy as np
import probe

from rp_jax.envs import circuit

PROBE = probe.make_pmdp(probe, probe.make_params(slip=0.2))


@functools.cache
def narrow():
    """Circuit with a shield of untrained weights, so that it interferes at random."""
    params = circuit.make_params("circle", time_limit=25)
    model = probe.threat_model(probe.make_params())
    network = model.network.clone(num_actions=15)
    rng = np.random.default_rng(0)
    kernel, bias = rng.normal(0, 8, (3, 15)), rng.normal(-2, 1, 15)
    weights = {"kernel": jnp.asarray(kernel, jnp.float32), "bias": jnp.asarray(bias, jnp.float32)}
    wall = model.replace(
        source=params.wall, params={"params": {"Dense_0": weights}}, network=network
    )
    return probe.make_pmdp(circuit, params, 0.3, models={"wall": wall})


def eager(percept):
    """Prefers the right, where the pit is, then the left."""
    return jnp.tile(jnp.asarray([[0.0, 1.0, 2.0]]), (percept.secure.shape[0], 1))


def at(x):
    return lambda: PROBE.replace(x=jnp.asarray(x, jnp.float32))
