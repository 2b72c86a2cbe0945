"""Tables of exact threats, in place of networks."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax.envs import circuit, jam
from rp_jax.hazards import WallPoint
from rp_jax.recon import labels, sampling
from rp_jax.storage import StorageError
from rp_jax.threat import artefact, build
from rp_jax.threat.build import ThreatConfig
from rp_jax.threat.model import ThreatModel, ThreatTable
from rp_jax.threat.total import total_threat

SMALL = ThreatConfig(tabled=True, states=8_000, sampling="uniform", miss_rate=1.0, test_states=500)
KEY = jax.random.key(0)


@functools.cache
def sub_of(env):
    short = {"wall_horizon": 3} if env is jam else {"horizon": 3}  # to compile soon
    return env.sub_rmdps(env.make_params(**short))["wall"]


@functools.cache
def learned(env, **changes):
    return build.learn_threat(KEY, sub_of(env), dataclasses.replace(SMALL, **changes), 0.01)


def nodes_of(model):
    values, shape = model.params["params"], model.network.shape
    axes = [values["low"][k] + values["step"][k] * np.arange(n) for k, n in enumerate(shape)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def test_a_table_by_hand():
    table = ThreatTable((2, 3), 1)
    values = {
        "low": jnp.asarray([0.0, 10.0]),
        "step": jnp.asarray([1.0, 2.0]),
        "logits": jnp.arange(6.0)[:, None],
    }
    look = lambda *features: table.apply({"params": values}, jnp.asarray(features))[0]  # noqa: E731
    assert look(0.0, 10.0) == 0
    assert look(0.4, 13.1) == 2  # nodes at 0 and 1; at 10, 12 and 14
    assert look(0.6, 12.9) == 4
    assert look(-5.0, 99.0) == 2  # the nearest one there is
    assert np.isnan(look(np.nan, 10.0))
    assert np.isnan(look(0.0, np.inf))
    assert table.apply({"params": values}, jnp.zeros((4, 7, 2))).shape == (4, 7, 1)


@pytest.mark.parametrize("env", [circuit, jam])
def test_a_grid_covers_the_window_all_reachable_speeds_and_mirror_images(env):
    sub = sub_of(env)
    for count in (1_000, 50_000):
        low, step, shape = sub.source.grid(sub.body, count)
        assert 0.7 * count < np.prod(shape) < 1.6 * count
        high = low + step * (np.asarray(shape) - 1)
        window = sub.source.window
        assert (low[:2] <= np.asarray(window.lower) + 1e-6).all()
        assert (high[:2] >= np.asarray(window.upper) - 1e-6).all()
        places = (np.asarray(sub.body.speeds) - low[2]) / step[2]
        np.testing.assert_allclose(places, np.round(places), atol=1e-4)
        np.testing.assert_allclose(low[1], -high[1])


@pytest.mark.parametrize("env", [circuit, jam])
def test_threats_are_exact_at_the_nodes_and_near_them_elsewhere(env):
    sub, found = sub_of(env), learned(env)
    model = found.model
    nodes = nodes_of(model).reshape(-1, 3)
    some = jnp.asarray(np.random.default_rng(0).choice(nodes, 300), jnp.float32)
    body, hazard = sampling.states(sub, some)
    true = labels.label(KEY, body, hazard, sub, labels.exact_threat).threat
    np.testing.assert_allclose(model(some), true, atol=1e-5)
    assert found.report["mae"] < 0.06  # of states in between, with few nodes
    assert found.curve == []
    assert set(found.seconds) == {"labels", "fit", "report"}


def test_more_nodes_are_nearer_to_the_truth():
    assert learned(jam, states=40_000).report["mae"] < 0.7 * learned(jam).report["mae"]


def test_threats_are_symmetrical_as_the_world_is():
    sub, model = sub_of(jam), learned(jam).model
    features = sampling.uniform(KEY, sub, 500)
    mirrored = model(sub.source.mirrored(features))
    images = sub.body.mirrored_threats()
    assert np.mean(np.abs(mirrored[:, images] - model(features)) > 1e-5) < 0.02  # ties of nodes


def test_a_table_adds_up_is_calibrated_and_comes_back_from_a_file(tmp_path):
    sub, model = sub_of(jam), learned(jam, miss_rate=0.05).model
    assert model.shift > 0
    artefact.save(tmp_path, "jam", {"wall": model}, {"wall": sub}, {})
    again = artefact.load(tmp_path, {"wall": sub})[0]["wall"]
    assert isinstance(again, ThreatModel)
    features = sampling.uniform(KEY, sub, 100)
    np.testing.assert_array_equal(again(features), model(features))
    params = jam.make_params(wall_horizon=3)
    state = jam.reset(KEY, params).replace(time=jnp.zeros((), jnp.int32))
    bodies = jax.tree.map(lambda a: a[None], state.body)
    walls = jax.tree.map(lambda a: a[None], jam.hazards(state, params)["wall"])
    said = total_threat({"wall": again}, bodies, {"wall": walls})
    each = jax.vmap(sub.source.features, (None, 0))(state.body, walls.state[0])
    inside = jax.vmap(sub.source.in_reach, (None, 0))(state.body, walls.state[0])
    present = inside & walls.present[0]
    wanted = jnp.sum(jnp.where(present[:, None], model(each), 0.0), axis=0)
    np.testing.assert_allclose(said[0], wanted, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("shape", [[0, 2, 2], [3], "ab", [10**4, 10**4, 3], [2.0, 2, 2]])
def test_absurd_shapes_in_files_are_refused(shape, tmp_path):
    with pytest.raises(StorageError, match=r"wall: shape is .*; it must list 3 numbers of nodes"):
        artefact._network("wall", {"shape": shape}, 15, 3)


def test_what_cannot_be_tabled_is_named():
    params = jam.make_params(3)
    moving = jam.sub_rmdps(params)["obstacle"]
    with pytest.raises(ValueError, match=r"obstacle\.tabled is True; it must be False for hazards"):
        build.check_config("obstacle", SMALL, moving)
    build.check_config("wall", SMALL, sub_of(jam))
    with pytest.raises(ValueError, match=r"config\.tabled is True"):
        build.learn_threat(KEY, moving, SMALL, 0.01)
    with pytest.raises(ValueError, match=r"wall\.exact is False; with tabled it must be True"):
        build.check_config("wall", dataclasses.replace(SMALL, exact=False), sub_of(jam))


class Behind(WallPoint):
    """Inherits a grid, and has features of its own."""

    def features(self, body, hazard):
        return -super().features(body, hazard)


def test_a_grid_of_other_features_is_named():
    sub = sub_of(jam)
    fields = {name: getattr(sub.source, name) for name in sub.source.__dataclass_fields__}
    with pytest.raises(ValueError, match="grid of the source: its nodes must be features"):
        build.tabled(KEY, sub.replace(source=Behind(**fields)), 1_000)


class Flat(WallPoint):
    """Its grid leaves the speed out."""

    def grid(self, model, nodes):
        return tuple(part[:2] for part in super().grid(model, nodes))


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        (Behind, "^wall: grid of the source: its nodes must be features"),
        (Flat, r"^wall: grid of the source: .* the lengths \(2, 2, 2\); each must be 3, as"),
    ],
)
def test_a_grid_that_does_not_fit_the_features_is_refused_before_any_label(kind, says):
    sub = sub_of(jam)
    fields = {name: getattr(sub.source, name) for name in sub.source.__dataclass_fields__}
    config = build.ThreatConfig(states=1_000, tabled=True, exact=True)
    build.check_config("wall", config, sub)
    with pytest.raises(ValueError, match=says):
        build.check_config("wall", config, sub.replace(source=kind(**fields)))
