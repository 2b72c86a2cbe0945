import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401
from scipy.special import expit

from rp_jax.planning.networks import NETWORKS, POOLS, PaperNetwork, TunedNetwork
from rp_jax.planning.percept import Encoded

SCALE = (1.0, 0.5, 10.0)
start = jax.jit(lambda network, key, seen: network.init(key, seen), static_argnums=0)
ask = jax.jit(lambda network, params, seen: network.apply(params, seen), static_argnums=0)


def seen(lead=(4,), bins=24):
    rng = np.random.default_rng(0)
    scan = np.where(rng.random((*lead, bins)) < 0.3, 255, rng.integers(0, 255, (*lead, bins)))
    return Encoded(
        scan=jnp.asarray(scan, jnp.uint8),
        rest=jnp.asarray(rng.normal(size=(*lead, 3)), jnp.float32),
    )


def layers(params):
    return {
        name: (np.asarray(layer["kernel"], float), np.asarray(layer["bias"], float))
        for name, layer in params["params"].items()
        if name.startswith("Dense")
    }


def test_the_tuned_network_is_a_perceptron_on_nearness_and_scaled_values():
    encoded = seen()
    network = TunedNetwork(num_actions=5, scale=SCALE, hidden=(7, 6))
    params = start(network, jax.random.key(0), encoded)
    nearness = 1 - np.asarray(encoded.scan, float) / 255  # 0 where nothing is seen
    z = np.concatenate([nearness, np.asarray(encoded.rest) * SCALE], axis=-1)
    found = layers(params)
    for name in ("Dense_0", "Dense_1"):
        z = z @ found[name][0] + found[name][1]
        z = z * expit(z)
    z = z @ found["Dense_2"][0] + found["Dense_2"][1]
    np.testing.assert_allclose(ask(network, params, encoded), z, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("bins", "pools"), [(24, 3), (21, 2), (13, 1), (8, 1)])
def test_the_paper_s_network_is_a_convolution_a_pool_and_tanh_units(bins, pools):
    encoded = seen(bins=bins)
    network = PaperNetwork(num_actions=5, scale=SCALE)
    params = start(network, jax.random.key(0), encoded)
    params["params"]["bias"] = jnp.asarray([0.1, -0.2, 0.3])
    found = layers(params)
    scan = np.asarray(encoded.scan, float) / 255
    scan[scan == 1] = 0  # nothing seen is 0 in the paper
    kernel, bias = (np.asarray(params["params"][name], float) for name in ("kernel", "bias"))
    assert kernel.shape == (6, 3)
    wide = np.stack([scan[:, i : i + 6] @ kernel for i in range(bins - 5)], axis=1) + bias
    wide = np.maximum(wide, 0)
    pooled = np.stack([wide[:, i : i + 8].max(axis=1) for i in range(0, bins - 5, 8)], axis=1)
    assert pooled.shape == (4, pools, 3)  # the last pool may be partly filled
    z = np.swapaxes(pooled, 1, 2).reshape(4, -1)  # one channel after another
    z = np.concatenate([z, np.asarray(encoded.rest)], axis=-1)
    for name, width in (("Dense_0", 50), ("Dense_1", 20)):
        z = np.tanh(z @ found[name][0] + found[name][1])
        assert z.shape == (4, width)
    z = z @ found["Dense_2"][0] + found["Dense_2"][1]
    np.testing.assert_allclose(ask(network, params, encoded), z, rtol=1e-4, atol=1e-5)


def test_the_paper_s_network_without_a_lidar_is_two_layers_of_fifty_tanh_units():
    encoded = seen(bins=0)
    network = PaperNetwork(num_actions=5, scale=SCALE)
    params = start(network, jax.random.key(0), encoded)
    found, z = layers(params), np.asarray(encoded.rest)
    for name in ("Dense_0", "Dense_1"):
        z = np.tanh(z @ found[name][0] + found[name][1])
        assert z.shape == (4, 50)
    z = z @ found["Dense_2"][0] + found["Dense_2"][1]
    np.testing.assert_allclose(ask(network, params, encoded), z, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("lead", [(), (1,), (2, 3)])
def test_leading_axes_are_kept(name, lead):
    network = NETWORKS[name](num_actions=5, scale=SCALE)
    params = start(network, jax.random.key(0), seen())
    many = seen(lead)
    values = ask(network, params, many)
    assert values.shape == (*lead, 5)
    rows = jax.tree.map(lambda a: a.reshape(-1, a.shape[-1]), many)
    np.testing.assert_allclose(
        values.reshape(-1, 5), ask(network, params, rows), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("name", NETWORKS)
def test_the_scan_makes_a_difference(name):
    network = NETWORKS[name](num_actions=5, scale=SCALE)
    encoded = seen()
    params = start(network, jax.random.key(0), encoded)
    nearer = encoded._replace(scan=encoded.scan // 4)
    assert (ask(network, params, encoded) != ask(network, params, nearer)).any()


def test_every_network_says_how_the_scan_is_pooled():
    assert set(POOLS) == set(NETWORKS)
