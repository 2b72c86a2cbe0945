import dataclasses
import functools
from itertools import groupby

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401

from rp_jax.envs import circuit, jam
from rp_jax.recon import sampling
from rp_jax.threat import build
from rp_jax.threat.build import ThreatConfig
from rp_jax.threat.fit import Dataset, FitConfig

TINY = ThreatConfig(
    states=150,
    paths=8,
    sampling="uniform",
    miss_rate=1.0,
    test_states=150,
    test_paths=8,
    fit=FitConfig(hidden=(16,), steps=200, batch=64, learning_rate=1e-2),
)
REPORT = {
    *("unsafe_states", "states_missed", "states_missed_upper95"),
    *("mae", "rmse", "bias", "spearman", "unsafe", "safe"),
    *("unsafe_called_safe", "safe_called_unsafe", "x", "shift"),
}
STAGES = {
    "uniform": ["labels", "fit", "report"],
    "preferential": ["labels", "fit", "more labels", "fit", "calibration", "report"],
}
SHORT = {circuit: {"horizon": 3}, jam: {"obstacle_horizon": 3}}  # rollouts, to compile soon
draw = jax.jit(sampling.uniform, static_argnums=2)
CASES = [(env, kind, s) for env, kind in ((circuit, "wall"), (jam, "obstacle")) for s in STAGES]


FITTED = {}  # by environment and way, what was fitted to, one fit after another


@functools.cache
def short(env):
    return env.sub_rmdps(env.make_params(**SHORT[env]))


@functools.cache
def built(env, kind, way):
    """A model learned in the given way of sampling, the latter calibrated; and the progress."""
    sub = short(env)[kind]
    miss_rate = 1.0 if way == "uniform" else 0.01
    states = 150 if way == "uniform" else 300  # in two parts of the same shape
    config = dataclasses.replace(TINY, states=states, sampling=way, miss_rate=miss_rate)
    told, fitted = [], build.fitted

    def spy(key, sub, data, *rest, **more):
        FITTED.setdefault((env, way), []).append(data)
        return fitted(key, sub, data, *rest, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "fitted", spy)
        found = build.learn_threat(
            jax.random.key(0), sub, config, 0.01, lambda *news: told.append(news)
        )
    return sub, found, told


each_case = pytest.mark.parametrize(("env", "kind", "way"), CASES)


@each_case
def test_it_learns_something_and_reports_it(env, kind, way):
    _, found, _ = built(env, kind, way)
    numbers = dict(found.report)
    if way == "preferential":  # the one that is calibrated
        assert numbers.pop("calibration")["unsafe_states"] > 0
    assert set(numbers) == REPORT
    assert all(np.isfinite(value) for value in numbers.values())
    assert found.report["x"] == 0.01
    assert found.report["unsafe"] + found.report["safe"] == 150 * 15
    assert found.report["spearman"] > 0.2
    assert set(found.seconds) == {"labels", "fit", "report"}
    assert min(found.seconds.values()) > 0


@each_case
def test_the_curve_goes_on_to_the_last_step(env, kind, way):
    _, found, _ = built(env, kind, way)
    assert [row["step"] for row in found.curve] == list(range(10, 201, 10))
    assert set(found.curve[0]) == {"step", "loss", "validation_loss", "validation_mae"}
    assert np.isfinite([list(row.values()) for row in found.curve]).all()
    assert found.curve[-1]["loss"] < found.curve[0]["loss"]


@each_case
def test_progress_is_told_stage_by_stage(env, kind, way):
    _, _, told = built(env, kind, way)
    stages = [(stage, list(news)) for stage, news in groupby(told, lambda news: news[0])]
    assert [stage for stage, _ in stages] == STAGES[way]
    for _, news in stages:
        done = [d for _, d, _ in news]
        totals = {t for _, _, t in news}
        assert done == sorted(set(done))
        assert totals == {done[-1]}


@each_case
def test_the_model_is_of_the_asked_size_and_errs_on_the_safe_side(env, kind, way):
    sub, found, _ = built(env, kind, way)
    assert found.model.network.hidden == (16,)
    assert found.report["shift"] == found.model.shift >= 0
    features = draw(jax.random.key(1), sub, 10)
    assert found.model(features).shape == (10, 15)
    if way == "uniform":
        assert found.model.shift == 0


def test_preferential_sampling_fits_to_all_that_was_labelled():
    for way in STAGES:
        built(circuit, "wall", way)
    whole, (scouted, both) = FITTED[circuit, "uniform"], FITTED[circuit, "preferential"]
    assert [len(data.features) for data in (*whole, scouted, both)] == [150, 150, 300]
    assert both.threat.shape == (300, 15)
    np.testing.assert_array_equal(both.features[:150], scouted.features)
    assert len(np.unique(both.features, axis=0)) == 300


def test_the_same_key_builds_the_same_bits():
    sub, found, _ = built(circuit, "wall", "uniform")
    again = build.learn_threat(jax.random.key(0), sub, TINY, 0.01)
    same = jax.tree.map(lambda a, b: bool((a == b).all()), found.model, again.model)
    assert jax.tree.all(same)
    assert found.curve == again.curve
    assert found.report == again.report


def test_the_report_is_that_of_fresh_states(exact):
    sub, found, _ = built(circuit, "wall", "uniform")
    fresh = draw(jax.random.key(2), sub, 2000)
    error = float(jnp.abs(found.model(fresh) - exact(fresh, sub).threat).mean())
    assert found.report["mae"] == pytest.approx(error, rel=0.25)


def test_a_fit_shorter_than_its_chunks_still_runs():
    sub, _, _ = built(circuit, "wall", "uniform")
    data = Dataset(draw(jax.random.key(3), sub, 150), jnp.full((150, 15), 0.1))
    config = dataclasses.replace(TINY.fit, steps=3)
    _, curve = build.fitted(jax.random.key(4), sub, data, config)
    assert [row["step"] for row in curve] == [1, 2, 3]


def test_a_fit_takes_no_fewer_steps_than_asked():
    sub, _, _ = built(circuit, "wall", "uniform")
    data = Dataset(draw(jax.random.key(3), sub, 150), jnp.full((150, 15), 0.1))
    _, curve = build.fitted(jax.random.key(4), sub, data, dataclasses.replace(TINY.fit, steps=39))
    assert [row["step"] for row in curve] == list(range(2, 42, 2))


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"states": 99}, "states"),
        ({"states": -5}, "states"),
        ({"paths": 1}, "paths"),
        ({"sampling": "clever"}, "sampling"),
        ({"miss_rate": 0.0}, "miss_rate"),
        ({"miss_rate": 1.5}, "miss_rate"),
        ({"miss_rate": float("nan")}, "miss_rate"),
        ({"confidence": 1.0}, "confidence"),
        ({"test_states": 9}, "test_states"),
        ({"test_paths": 0}, "test_paths"),
        ({"fit": FitConfig(batch=0)}, r"fit\.batch"),
    ],
)
def test_bad_settings_are_named(change, field):
    with pytest.raises(ValueError, match=rf"^wall\.{field} is .*must"):
        dataclasses.replace(TINY, **change).validate("wall")
