import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401

from rp_jax.envs import circuit, jam
from rp_jax.recon import sampling
from rp_jax.threat import build
from rp_jax.threat.fit import Dataset, FitConfig
from rp_jax.threat.model import ThreatModel, ThreatNetwork

KINDS = [(circuit, "wall"), (jam, "wall"), (jam, "obstacle")]
each_kind = pytest.mark.parametrize(("env", "kind"), KINDS, ids=["circuit", "wall", "obstacle"])
X = 0.01


@functools.cache
def sub_of(env, kind):
    return env.sub_rmdps(env.make_params())[kind]


uniform = jax.jit(sampling.uniform, static_argnums=2)
preferential = jax.jit(sampling.preferential, static_argnums=6)


def flat_model(sub, width, threat):
    """Says the same of every state and action."""
    weights = {"kernel": jnp.zeros((width, 15)), "bias": jnp.zeros(15)}
    shift = jnp.log(threat / (1 - threat))
    params = {"params": {"Dense_0": weights}}
    return ThreatModel(sub.source, params, jnp.ones(width), shift, ThreatNetwork((), 15))


@each_kind
def test_uniform_draws_lie_in_reach_and_fill_it(env, kind):
    sub = sub_of(env, kind)
    drawn = uniform(jax.random.key(1), sub, 2000)
    assert sub.source.window.contains(drawn[:, :2]).all()
    pairs = jax.vmap(sub.source.state_of)(drawn)
    speeds = [pairs[0].speed] if kind == "wall" else [pairs[0].speed, pairs[1].speed]
    at = jax.vmap(sub.source.window_at)(*speeds)
    low, high = np.asarray(at.lower), np.asarray(at.upper)
    assert jax.vmap(sub.source.in_reach)(*pairs).mean() > 0.999  # but for rounding
    quarter = np.quantile((np.asarray(drawn[:, :2]) - low) / (high - low), [0.25, 0.75], axis=0)
    np.testing.assert_allclose(quarter, [[0.25, 0.25], [0.75, 0.75]], atol=0.05)
    own = np.asarray(drawn[:, -1])
    for speed in np.asarray(sub.body.speeds):
        assert (own == speed).mean() > 0.25 / len(sub.body.speeds)
    assert (~np.isin(own, np.asarray(sub.body.speeds))).mean() > 0.4


def test_uniform_draws_follow_their_key():
    sub = sub_of(circuit, "wall")
    one, two, other = (uniform(jax.random.key(k), sub, 2000) for k in (1, 1, 2))
    np.testing.assert_array_equal(one, two)
    assert not np.isin(one[:, 0], other[:, 0]).any()


def test_interest_is_greatest_at_the_threshold():
    def of(threat, x=X):
        return float(sampling.interest(jnp.asarray([threat]), x))

    doubt = lambda t: np.sqrt(t * (1 - t))  # noqa: E731
    assert of(X) == pytest.approx(1 + doubt(X), rel=1e-5)
    assert of(4 * X) == pytest.approx(np.exp(-1) + doubt(4 * X), rel=1e-4)
    assert of(X / 4) == pytest.approx(np.exp(-1) + doubt(X / 4), rel=1e-4)
    assert of(0.5) == pytest.approx(0.5 + np.exp(-((np.log(50) / np.log(4)) ** 2)), rel=1e-4)
    assert of(0.0) < 1e-3
    assert of(1.0) < 1e-4


def test_interest_is_the_mean_over_the_actions():
    threat = jnp.asarray([[0.0, 0.01, 0.5, 1.0], [0.2, 0.2, 0.2, 0.2]])
    each = [np.mean([sampling.interest(t[None], X) for t in row]) for row in threat]
    np.testing.assert_allclose(sampling.interest(threat, X), each, rtol=1e-5)


@functools.cache
def scouted(exact):
    """A wall point, labelled states and a model fitted to them for a moment."""
    sub = sub_of(circuit, "wall")
    features = uniform(jax.random.key(3), sub, 2000)
    data = Dataset(features, exact(features, sub).threat)
    config = FitConfig(hidden=(32,), steps=400, batch=256, learning_rate=1e-2)
    model, _ = build.fitted(jax.random.key(4), sub, data, config)
    return sub, data, model


def near_x(threat):
    """Share of the states with an action whose threat is within a factor of 4 of X."""
    threat = np.asarray(threat)
    return ((threat > X / 4) & (threat < 4 * X)).any(axis=-1).mean()


def test_preferential_draws_are_nearer_to_the_threshold(exact):
    sub, data, model = scouted(exact)
    drawn = preferential(jax.random.key(5), sub, model, *data, X, 2000)
    assert drawn.shape == (2000, 3)
    assert sub.source.window.contains(drawn[:, :2]).all()
    assert np.isfinite(drawn).all()
    threat = exact(drawn, sub).threat
    assert near_x(threat) > 1.15 * near_x(data.threat)
    assert (threat.max(axis=-1) == 0).mean() > 0.02  # none is out of the question


def test_preferential_draws_follow_their_key(exact):
    sub, data, model = scouted(exact)
    one, two, other = (
        np.asarray(preferential(jax.random.key(k), sub, model, *data, X, 2000)) for k in (5, 5, 6)
    )
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)


@pytest.mark.parametrize(("env", "kind"), KINDS[1:], ids=["wall", "obstacle"])
def test_half_the_candidates_lie_near_states_where_the_model_errs(env, kind):
    sub = sub_of(env, kind)
    features = uniform(jax.random.key(7), sub, 2000)
    model = flat_model(sub, features.shape[1], 1e-6)
    wrong = jnp.arange(2000) < 2
    threat = jnp.where(wrong[:, None], 0.9, 1e-6) * jnp.ones((1, 15))
    drawn = preferential(jax.random.key(8), sub, model, features, threat, X, 2000)
    assert sub.source.window.contains(drawn[:, :2]).all()
    size = np.asarray(sub.source.window.upper - sub.source.window.lower)
    gap = np.abs(np.asarray(drawn)[:, None, :2] - np.asarray(features)[None, :2, :2])
    close = (gap <= 0.0501 * size).all(axis=-1).any(axis=-1).mean()
    assert 0.4 < close < 0.65


def test_the_thinning_keeps_what_the_model_takes_to_be_near_the_threshold():
    sub = sub_of(circuit, "wall")
    right = float(sub.source.window.upper[0])
    # A model for which the threshold is met exactly in the middle of the window.
    kernel = jnp.zeros((3, 15)).at[0].set(60.0)
    bias = jnp.full(15, np.log(X / (1 - X)) - 60.0 * right / 2)
    weights = {"params": {"Dense_0": {"kernel": kernel, "bias": bias}}}
    model = ThreatModel(sub.source, weights, jnp.ones(3), jnp.zeros(()), ThreatNetwork((), 15))
    features = uniform(jax.random.key(9), sub, 2000)
    drawn = preferential(jax.random.key(10), sub, model, features, 1 - model(features), X, 2000)
    band = lambda f: float((jnp.abs(f[:, 0] - right / 2) < 0.03).mean())  # noqa: E731
    assert band(drawn) > 2 * band(features)
