import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401

from rp_jax.dynamics import angle_of
from rp_jax.envs import circuit, jam
from rp_jax.recon import sampling
from rp_jax.threat import fit
from rp_jax.threat.fit import Dataset, FitConfig

CONFIG = FitConfig(hidden=(16,), steps=400, batch=64, learning_rate=1e-2)


@functools.cache
def sub_of(env, kind):
    return env.sub_rmdps(env.make_params())[kind]


@functools.cache
def toy():
    """States of a wall point whose threat is the nearer, the higher; (1000, 15)."""
    sub = sub_of(circuit, "wall")
    features = sampling.uniform(jax.random.key(0), sub, 1000)
    distance = jnp.linalg.norm(features[:, :2], axis=-1, keepdims=True)
    return Dataset(features, jnp.broadcast_to(jax.nn.sigmoid(8 * (0.3 - distance)), (1000, 15)))


@functools.partial(jax.jit, static_argnames=("config", "steps"))
def run(model, state, data, config, steps):
    return fit.run(model, state, data, config, steps)


def start(key=1, config=CONFIG):
    return fit.init(jax.random.key(key), sub_of(circuit, "wall"), toy(), config)


def equal(a, b):
    return jax.tree.all(jax.tree.map(lambda x, y: bool((x == y).all()), a, b))


def test_the_loss_falls_to_that_of_the_truth():
    model, state = start()
    losses = []
    for _ in range(8):
        state, some = run(model, state, toy(), CONFIG, 50)
        losses += list(np.asarray(some))
    losses = np.asarray(losses)
    truth = toy().threat
    least = float(-(truth * jnp.log(truth) + (1 - truth) * jnp.log(1 - truth)).mean())
    assert losses[:20].mean() > least + 0.1
    assert losses[-20:].mean() < least + 0.02
    fitted = model.replace(params=state.params)
    assert jnp.abs(fitted(toy().features) - truth).mean() < 0.03


def test_the_cross_entropy_is_right_and_least_at_the_truth():
    truth = jnp.asarray([[0.2, 0.9], [0.0, 1.0]])
    said = jnp.asarray([[0.3, 0.5], [0.1, 0.8]])
    logits = jnp.log(said / (1 - said))
    t, s = np.asarray(truth), np.asarray(said)
    by_hand = -(t * np.log(s) + (1 - t) * np.log(1 - s)).mean()
    assert fit.cross_entropy(logits, truth) == pytest.approx(by_hand, rel=1e-5)
    sure = jnp.asarray([[0.2, 0.9]])
    best = fit.cross_entropy(jnp.log(sure / (1 - sure)), sure)
    for off in (-0.3, 0.3):
        assert fit.cross_entropy(jnp.log(sure / (1 - sure)) + off, sure) > best


def test_the_same_key_gives_the_same_bits():
    one = run(*start(), toy(), CONFIG, 50)
    two = run(*start(), toy(), CONFIG, 50)
    other = run(*start(key=2), toy(), CONFIG, 50)
    assert equal(one[0].params, two[0].params)
    assert not equal(one[0].params, other[0].params)


def test_two_halves_are_the_whole():
    model, state = start()
    whole, losses = run(model, state, toy(), CONFIG, 100)
    half, first = run(model, state, toy(), CONFIG, 50)
    half, second = run(model, half, toy(), CONFIG, 50)
    assert equal(whole.params, half.params)
    np.testing.assert_array_equal(losses, jnp.concatenate([first, second]))


def test_a_fresh_model_is_scaled_by_the_spread_of_the_data_and_not_shifted():
    model, _ = start()
    features = np.asarray(toy().features)
    np.testing.assert_allclose(model.scale, 1 / features.std(axis=0), rtol=1e-3)
    assert model.shift == 0
    assert model.network.hidden == (16,)
    assert model(toy().features[:3]).shape == (3, 15)


@pytest.mark.parametrize("cosine", [True, False])
def test_the_rate_follows_its_schedule(cosine):
    config = dataclasses.replace(CONFIG, steps=20, cosine=cosine)
    transform = fit.optimiser(config)
    state = transform.init(jnp.zeros(1))
    update = jax.jit(transform.update)
    sizes = []
    for _ in range(20):  # Adam's steps are as long as the rate, under a constant gradient
        change, state = update(jnp.ones(1), state)
        sizes.append(-float(change[0]))
    share = 0.5 * (1 + np.cos(np.pi * np.arange(20) / 20)) if cosine else np.ones(20)
    np.testing.assert_allclose(sizes, config.learning_rate * share, rtol=1e-3)


def test_a_split_is_a_partition():
    rows = jnp.arange(101.0)[:, None]
    train, held = fit.split(jax.random.key(0), Dataset(rows, -rows), 0.2)
    assert (len(train.features), len(held.features)) == (81, 20)
    both = np.concatenate([train.features, held.features])[:, 0]
    assert sorted(both) == list(range(101))
    for part in (train, held):
        np.testing.assert_array_equal(part.threat, -part.features)
    again, _ = fit.split(jax.random.key(1), Dataset(rows, -rows), 0.2)
    assert not np.array_equal(again.features, train.features)


@pytest.mark.parametrize(("env", "kind"), [(circuit, "wall"), (jam, "wall"), (jam, "obstacle")])
def test_mirroring_adds_each_state_seen_in_a_mirror(env, kind):
    sub = sub_of(env, kind)
    features = sampling.uniform(jax.random.key(1), sub, 50)
    threat = jnp.tile(jnp.arange(15.0), (50, 1))
    both = fit.mirror(Dataset(features, threat), sub)
    assert both.features.shape == (100, features.shape[1])
    np.testing.assert_array_equal(both.features[:50], features)
    np.testing.assert_array_equal(both.threat[:50], threat)
    flipped = np.asarray(features) * [1, -1, 1, -1, 1, 1][: features.shape[1]]
    np.testing.assert_allclose(both.features[50:], flipped)
    turns = np.degrees(np.asarray(angle_of(sub.body.actions.rotation)))
    gains = np.asarray(sub.body.actions.acceleration)
    for mine, its in enumerate(np.asarray(both.threat[50], int)):
        assert turns[mine] == pytest.approx(-turns[its], abs=1e-4)
        assert gains[mine] == gains[its]


@pytest.mark.parametrize("env", [circuit, jam])
def test_the_mirror_s_labels_are_those_of_the_mirrored_states(env, exact):
    sub = sub_of(env, "wall")
    near = sampling.uniform(jax.random.key(2), sub, 200)
    near = near[jnp.argsort(jnp.linalg.norm(near[:, :2], axis=-1))][:50]
    data = Dataset(near, exact(near, sub).threat)
    assert (jnp.abs(data.threat[:, 0] - data.threat[:, 4]) > 0.01).any()  # left is not right
    both = fit.mirror(data, sub)
    np.testing.assert_allclose(exact(both.features[50:], sub).threat, both.threat[50:], atol=1e-5)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"hidden": ()}, "hidden"),
        ({"hidden": (0,)}, "hidden"),
        ({"hidden": (10**6,)}, "hidden"),
        ({"activation": "tanh"}, "activation"),
        ({"steps": 0}, "steps"),
        ({"batch": -1}, "batch"),
        ({"learning_rate": 0.0}, "learning_rate"),
        ({"learning_rate": float("nan")}, "learning_rate"),
        ({"epsilon": -1e-8}, "epsilon"),
        ({"validation": 0.0}, "validation"),
        ({"validation": 1.0}, "validation"),
    ],
)
def test_bad_settings_are_named(change, field):
    with pytest.raises(ValueError, match=rf"^wall\.fit\.{field} is .*must"):
        dataclasses.replace(CONFIG, **change).validate("wall.fit")
