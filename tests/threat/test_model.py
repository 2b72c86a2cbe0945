import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from scipy.special import expit

from rp_jax.threat.model import ACTIVATIONS, ThreatModel, ThreatNetwork

call = jax.jit(lambda model, features: model(features))


def random_model(hidden=(8, 4), activation="silu", shift=0.0, knee=jnp.inf):
    network = ThreatNetwork(hidden, 3, activation)
    params = jax.jit(network.init)(jax.random.key(0), jnp.zeros(3))
    scale = jnp.asarray([0.5, 2.0, 10.0])
    return ThreatModel(None, params, scale, jnp.asarray(shift), network, jnp.asarray(knee))


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_logits_are_those_of_a_perceptron_on_scaled_features(activation):
    model = random_model(activation=activation, shift=0.75)
    features = np.random.default_rng(0).normal(size=(20, 3))
    act = {"relu": lambda z: np.maximum(z, 0), "silu": lambda z: z * expit(z)}[activation]
    layers = [
        {name: np.asarray(a, float) for name, a in model.params["params"][f"Dense_{i}"].items()}
        for i in range(3)
    ]
    z = features * [0.5, 2.0, 10.0]
    for layer in layers[:-1]:
        z = act(z @ layer["kernel"] + layer["bias"])
    z = z @ layers[-1]["kernel"] + layers[-1]["bias"] + 0.75
    np.testing.assert_allclose(model.logits(jnp.asarray(features)), z, rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose(model(jnp.asarray(features)), expit(z), rtol=2e-5, atol=2e-6)


def test_threats_lie_between_0_and_1_however_far_the_features():
    features = jnp.asarray(np.random.default_rng(1).normal(size=(100, 3)) * 1e3)
    threat = np.asarray(random_model()(features))
    assert ((threat >= 0) & (threat <= 1)).all()


@pytest.mark.parametrize("lead", [(), (1,), (5,), (2, 3)])
def test_leading_axes_are_kept(lead):
    model = random_model()
    features = jax.random.normal(jax.random.key(1), (*lead, 3))
    threat = call(model, features)
    assert threat.shape == (*lead, 3)
    rows = [call(model, row) for row in features.reshape(-1, 3)]
    np.testing.assert_allclose(threat.reshape(-1, 3), jnp.stack(rows), rtol=1e-5)


def test_a_shift_upwards_raises_every_threat():
    features = 0.1 * jax.random.normal(jax.random.key(2), (50, 3))
    plain, shifted = random_model()(features), random_model(shift=0.5)(features)
    assert (shifted > plain).all()


@pytest.mark.parametrize("shift", [0.0, 0.5, 3.0])
def test_the_shift_fades_above_the_knee(shift):
    knee = -2.0
    fitted = jnp.linspace(-20, 20, 4001)
    moved = random_model(shift=shift, knee=knee).shifted(fitted)
    low, high = fitted <= knee, fitted >= knee + 2 * shift
    np.testing.assert_allclose(moved[low], fitted[low] + shift, rtol=1e-6)
    np.testing.assert_array_equal(moved[high], fitted[high])
    assert (jnp.diff(moved) > 0).all()
    between = ~low & ~high
    assert (moved[between] > fitted[between]).all()
    assert (moved[between] < fitted[between] + shift).all()


def test_the_probe_s_weights_say_what_enumeration_says(exact):
    params = probe.make_params()
    sub = probe.sub_rmdps(params)["pit"]
    features = jnp.asarray([[d, 0.0, 0.0] for d in (0.0, 1.0, 2.0)])
    true = exact(features, sub).threat
    np.testing.assert_allclose(probe.threat_model(params)(features), true, atol=2e-3)
    np.testing.assert_allclose(true, [[1, 1, 1], [0, 0, 0.999], [0, 0, 0]], rtol=1e-6)
