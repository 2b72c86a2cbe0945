"""The stated share of states with an unsafe action called safe, and the stated confidence."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rp_jax.envs import jam
from rp_jax.recon import sampling
from rp_jax.statistics import events_allowed, upper_bound
from rp_jax.threat import build, fit
from rp_jax.threat.fit import Dataset

SUB = jam.sub_rmdps(jam.make_params(1))["wall"]


def toy(n=1000, seed=0):
    """Threats of fifteen actions that grow towards the hazard."""
    features = sampling.uniform(jax.random.key(seed), SUB, n)
    near = jnp.exp(-8 * jnp.linalg.norm(features[:, :2], axis=-1))
    return Dataset(features, jnp.clip(near[:, None] * jnp.linspace(0.1, 1.5, 15)[None], 0, 1))


def fresh_model(bias=0.0):
    model, _ = fit.init(jax.random.key(0), SUB, toy(), fit.FitConfig(hidden=(8,)))
    last = model.params["params"]["Dense_1"]
    return model.replace(
        params={
            "params": {**model.params["params"], "Dense_1": {**last, "bias": last["bias"] + bias}}
        }
    )


def missed(model, data, x):
    unsafe = np.asarray(data.threat) > x
    safe = np.asarray(model(data.features)) <= x
    return int((unsafe & safe).any(1).sum()), int(unsafe.any(1).sum())


@pytest.mark.parametrize("x", [0.001, 0.01, 0.3])
@pytest.mark.parametrize("rate", [0.2, 0.05])
def test_the_shift_is_the_least_that_the_bound_allows(rate, x):
    model = fresh_model(-8.0)
    careful, facts = build.calibrated(model, toy(), x, rate, 0.9)
    k, n = missed(careful, toy(), x)
    assert (k, n) == (facts.missed, facts.unsafe_states)
    assert upper_bound(k, n, 0.9) <= facts.rate <= rate
    less = careful.replace(shift=careful.shift - 0.1)
    assert upper_bound(missed(less, toy(), x)[0], n, 0.9) > rate
    assert careful.shift > 0
    assert careful.knee == pytest.approx(np.log(x / (1 - x)))


def test_too_few_states_show_what_they_can():
    model = fresh_model(-8.0)
    careful, facts = build.calibrated(model, toy(30), 0.01, 1e-4, 0.95)
    assert facts.missed == 0
    assert missed(careful, toy(30), 0.01)[0] == 0
    assert facts.rate == pytest.approx(upper_bound(0, facts.unsafe_states, 0.95))
    assert facts.rate > 1e-4


def test_it_never_shifts_downwards():
    assert build.calibrated(fresh_model(9.0), toy(), 0.01, 0.5, 0.9)[0].shift == 0


def test_threats_far_above_x_stay_as_fitted():
    model = fresh_model(-8.0)
    careful, _ = build.calibrated(model, toy(), 0.01, 0.05, 0.9)
    far = careful.knee + 2 * careful.shift
    at = lambda logit: careful.shifted(jnp.asarray(logit))  # noqa: E731
    assert at(far) == far
    assert at(careful.knee) == pytest.approx(float(careful.knee + careful.shift))


def test_it_leaves_a_model_alone_where_nothing_can_be_learned():
    model, harmless = fresh_model(), toy()._replace(threat=jnp.zeros((1000, 15)))
    for data, x in ((harmless, 0.01), (toy(), 1.0), (toy(), 0.0)):
        same, facts = build.calibrated(model, data, x, 0.1, 0.9)
        assert same.shift == 0
        assert facts.rate == 1.0


def test_the_statement_holds_as_often_as_it_says():
    """Over draws of the calibrating states, the true share exceeds the rate in at most a tenth."""
    x, rate, confidence = 0.01, 0.1, 0.9
    model = fresh_model(-8.0)
    far = toy(20_000, seed=1)
    held = 0
    for seed in range(200):
        careful, _ = build.calibrated(model, toy(150, seed=2 + seed), x, rate, confidence)
        k, n = missed(careful, far, x)
        held += k / n <= rate
    assert held >= stats.binom.ppf(1e-4, 200, confidence)
    assert held < 200  # or it errs on the safe side beyond reason


def test_states_near_the_threshold_are_drawn_where_threat_is_near_it():
    def model(features):
        return jnp.tile(jnp.exp(-8 * jnp.linalg.norm(features[:, :2], axis=-1))[:, None], (1, 15))

    near = build.near_threshold(jax.random.key(3), SUB, jax.tree_util.Partial(model), 0.01, 500)
    anywhere = sampling.uniform(jax.random.key(4), SUB, 500)
    gap = [np.abs(np.log(np.asarray(model(f))[:, 0] / 0.01)).mean() for f in (near, anywhere)]
    assert gap[0] < 0.9 * gap[1]
    assert 10 < len(near) <= 500


@pytest.mark.parametrize("n", [0, 1, 28, 29, 100, 5000])
@pytest.mark.parametrize("rate", [0.001, 0.1, 0.5])
def test_as_many_events_are_allowed_as_the_bound_lets_through(n, rate):
    k = events_allowed(n, rate)
    assert -1 <= k <= n
    if k >= 0:
        assert upper_bound(k, n) <= rate
    if n > k:
        assert n == 0 or upper_bound(k + 1, n) > rate
