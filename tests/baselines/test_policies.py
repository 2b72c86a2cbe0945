import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401
from scipy import stats

from rp_jax.baselines.policies import ACTORS, LOG_STD, Categorical, Critic, Gaussian
from rp_jax.planning.percept import Encoded

SCALE = (1.0, 0.5, 10.0)
RNG = np.random.default_rng(0)


def seen(rows=6):
    scan = jnp.asarray(RNG.integers(0, 256, (rows, 5)), jnp.uint8)
    return Encoded(scan, jnp.asarray(RNG.normal(size=(rows, 3)), jnp.float32))


def gaussian(seed):
    rng = np.random.default_rng(seed)
    return Gaussian(jnp.asarray(rng.normal(size=(4, 2))), jnp.asarray(rng.normal(-1, 0.5, (4, 2))))


def categorical(seed):
    return Categorical(jnp.asarray(np.random.default_rng(seed).normal(size=(4, 3))))


def test_the_density_is_that_of_the_normal_distribution():
    policy, action = gaussian(0), RNG.normal(size=(4, 2))
    expected = stats.norm(policy.mean, np.exp(policy.log_std)).logpdf(action).sum(axis=-1)
    np.testing.assert_allclose(policy.log_prob(jnp.asarray(action)), expected, rtol=1e-4)


def test_log_probabilities_are_those_of_the_logits():
    policy = categorical(0)
    weights = np.exp(policy.logits)
    expected = np.log(weights / weights.sum(axis=-1, keepdims=True))
    for action in range(3):
        found = policy.log_prob(jnp.full(4, action))
        np.testing.assert_allclose(found, expected[:, action], rtol=1e-5)


@pytest.mark.parametrize("make", [gaussian, categorical])
def test_samples_follow_the_density(make):
    policy = make(1)
    draws = jax.vmap(policy.sample)(jax.random.split(jax.random.key(0), 20_000))
    if make is gaussian:
        np.testing.assert_allclose(draws.mean(axis=0), policy.mean, atol=0.03)
        np.testing.assert_allclose(draws.std(axis=0), np.exp(policy.log_std), rtol=0.03)
    else:
        shares = (draws[..., None] == jnp.arange(3)[None, None]).mean(axis=0)
        np.testing.assert_allclose(shares, np.exp(policy.log_probs), atol=0.015)


@pytest.mark.parametrize("make", [gaussian, categorical])
def test_the_divergence_is_the_mean_of_the_log_ratio(make):
    policy, other = make(1), make(2)
    draws = jax.vmap(policy.sample)(jax.random.split(jax.random.key(1), 50_000))
    ratio = jax.vmap(policy.log_prob)(draws) - jax.vmap(other.log_prob)(draws)
    error = 4 * ratio.std(axis=0) / np.sqrt(50_000)
    assert (np.abs(policy.kl(other) - ratio.mean(axis=0)) < error).all()
    np.testing.assert_allclose(policy.kl(policy), np.zeros(4), atol=1e-6)


def test_modes_are_the_likeliest_actions():
    np.testing.assert_array_equal(gaussian(0).mode, gaussian(0).mean)
    np.testing.assert_array_equal(categorical(0).mode, np.argmax(categorical(0).logits, axis=-1))


@pytest.mark.parametrize("name", ACTORS)
def test_a_fresh_policy_is_even_handed(name):
    network = ACTORS[name](num_actions=4, scale=SCALE)
    weights = network.init(jax.random.key(0), seen())
    name_of = {"gaussian": "mean", "categorical": "logits"}[name]
    shapes = [weights["params"][f"{name_of}_{i}"]["kernel"].shape for i in range(2)]
    assert shapes == [(8, 64), (64, 32)]
    policy = network.apply(weights, seen())
    if name == "gaussian":
        np.testing.assert_allclose(policy.mean, np.zeros((6, 2)), atol=0.2)
        np.testing.assert_allclose(policy.log_std, np.full((6, 2), LOG_STD))
    else:
        np.testing.assert_allclose(np.exp(policy.log_probs), np.full((6, 4), 0.25), atol=0.05)


def test_the_values_of_reward_and_of_danger_share_nothing():
    network = Critic(scale=SCALE)
    elapsed = jnp.linspace(0.0, 1.0, 6)
    weights = network.init(jax.random.key(0), seen(), elapsed)
    for place, name in enumerate(("reward", "danger")):

        def total(w, i=place):
            return jnp.sum(network.apply(w, seen(), elapsed)[:, i])

        moved = {
            layer: any(bool((a != 0).any()) for a in jax.tree.leaves(grads))
            for layer, grads in jax.grad(total)(weights)["params"].items()
        }
        assert moved == {layer: layer.startswith(name) for layer in moved}
        assert len(moved) == 6
