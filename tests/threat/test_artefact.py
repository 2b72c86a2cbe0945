import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401

from examples.trolley import world as trolley
from rp_jax import storage
from rp_jax.envs import circuit, jam
from rp_jax.storage import StorageError
from rp_jax.threat import artefact
from rp_jax.threat.model import ThreatModel, ThreatNetwork


@functools.cache
def subs_of(env, **changes):
    return env.sub_rmdps(env.make_params(**changes))


@functools.cache
def models_of(env):
    """Untrained networks of different sizes."""
    models = {}
    widths = {"wall": 3, "obstacle": 6}
    for kind, sub in subs_of(env).items():
        network = ThreatNetwork((8, widths[kind]), 15, "silu" if kind == "wall" else "relu")
        weights = network.init(jax.random.key(widths[kind]), jnp.zeros(widths[kind]))
        scale = jnp.arange(1.0, widths[kind] + 1)
        shift, knee = jnp.asarray(0.25), jnp.asarray(-2.0)
        models[kind] = ThreatModel(sub.source, weights, scale, shift, network, knee)
    return models


@pytest.fixture
def saved(tmp_path):
    artefact.save(tmp_path, "jam", models_of(jam), subs_of(jam), {"x": 0.01})
    return tmp_path


def refused(folder, message, subs=None):
    with pytest.raises(StorageError, match=message):
        artefact.load(folder, subs_of(jam) if subs is None else subs)


def arrays_of(folder):
    (path,) = folder.glob("arrays-*.bin")
    return path


def edit(folder, change):
    """Forges the facts in the manifest."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    change(manifest["about"])
    manifest["seal"] = storage.manifest_checksum(manifest)
    path.write_text(json.dumps(manifest))


@pytest.mark.parametrize("env", [circuit, jam])
def test_models_come_back_bit_by_bit(env, tmp_path):
    name = env.__name__
    artefact.save(tmp_path, name, models_of(env), subs_of(env), {"x": 0.01})
    found = artefact.load(tmp_path, subs_of(env))[0]
    assert set(found) == set(models_of(env))
    for kind, model in models_of(env).items():
        assert found[kind].network == model.network
        assert jax.tree.structure(found[kind]) == jax.tree.structure(model)
        same = jax.tree.map(lambda a, b: bool((a == b).all()), found[kind], model)
        assert jax.tree.all(same)
        features = jax.random.normal(jax.random.key(0), (5, model.scale.shape[0]))
        np.testing.assert_array_equal(found[kind](features), model(features))


def test_it_says_what_it_is(saved):
    about = storage.read_manifest(saved, artefact.KIND)["about"]
    assert about["environment"] == "jam"
    assert about["x"] == 0.01
    assert about["networks"]["obstacle"] == {"hidden": [8, 6], "activation": "relu"}


def test_it_serves_other_counts_and_time_limits(saved):
    others = subs_of(jam, num_obstacles=15, time_limit=7, fidelity="paper")
    assert set(artefact.load(saved, others)[0]) == {"wall", "obstacle"}


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.999])
def test_a_flipped_bit_is_found(share, saved):
    path = arrays_of(saved)
    data = bytearray(path.read_bytes())
    data[int(share * len(data))] ^= 0x10
    path.write_bytes(data)
    refused(saved, r"arrays-\w+\.bin: the checksum differs")


@pytest.mark.parametrize("keep", [0, 100, -1])
def test_a_cut_file_is_found(keep, saved):
    path = arrays_of(saved)
    path.write_bytes(path.read_bytes()[:keep])
    refused(saved, r"arrays-\w+\.bin: \d+ bytes; the manifest says")


def test_a_cut_manifest_is_found(saved):
    path = saved / "manifest.json"
    path.write_bytes(path.read_bytes()[:-20])
    refused(saved, r"manifest\.json: cannot be read")


def test_a_missing_file_is_named(saved):
    arrays_of(saved).unlink()
    refused(saved, r"arrays-\w+\.bin: cannot be read")
    (saved / "manifest.json").unlink()
    refused(saved, r"manifest\.json")


def test_a_missing_folder_is_named(tmp_path):
    refused(tmp_path / "nowhere", r"nowhere: there is no manifest\.json; .* threat function")


def test_other_hazards_are_refused(saved, tmp_path):
    refused(
        saved,
        r"hazards are \['obstacle', 'wall'\]; they must be \['wall'\]",
        {"wall": subs_of(jam)["wall"]},
    )
    artefact.save(tmp_path / "c", "jam", models_of(circuit), subs_of(circuit), {})
    refused(tmp_path / "c", r"hazards are \['wall'\]; they must be \['obstacle', 'wall'\]")


def test_another_thing_is_refused(tmp_path):
    storage.save(tmp_path, "Q-network", {"a": jnp.ones(2)}, {"environment": "jam"})
    refused(tmp_path, "kind is 'Q-network'; it must be 'threat function'")


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"radius": 0.12}, r"wall: source/radius is 0\.1\d*; .* must be 0\.1(2|19)"),
        ({"wall_horizon": 6}, r"wall: source/horizon is 5; .* must be 6"),
        ({"obstacle_horizon": 7}, r"obstacle: source/horizon is 8; .* must be 7"),
        ({"beta": 0.99}, r"(wall|obstacle): beta is 0\.999\d*; .* must be 0\.9(9|89)"),
    ],
)
def test_other_dynamics_are_refused(change, field, saved):
    refused(saved, field, subs=subs_of(jam, **change))


def test_another_body_is_refused(tmp_path):
    subs = trolley.sub_rmdps(trolley.make_params())
    models = {"cart": models_of(jam)["wall"]}
    artefact.save(tmp_path, "trolley", models, subs, {})
    body = subs["cart"].body
    heavy = body.replace(model=body.model.replace('mass="1"', 'mass="2"'))
    subs["cart"] = subs["cart"].replace(body=heavy)
    refused(tmp_path, "cart: body/model is <mujoco.*; for this .* must be", subs)


@pytest.mark.parametrize("statics", [[], {"wall": None}, {"wall": {"source/horizon": [5]}}])
def test_forged_statics_are_refused(statics, saved):
    edit(saved, lambda about: about.update(statics=statics))
    refused(saved, r"wall: (statics is .* must be a table|source/horizon is \[5\]; .* must be 5)")


def test_what_was_saved_without_statics_still_loads(saved):
    edit(saved, lambda about: about.pop("statics"))
    assert set(artefact.load(saved, subs_of(jam))[0]) == {"wall", "obstacle"}


def test_another_baseline_policy_is_refused(saved):
    subs = dict(subs_of(jam))
    body = subs["wall"].body
    timid = body.baseline.replace(probabilities=jnp.full(9, 1 / 9))
    subs["wall"] = subs["wall"].replace(body=body.replace(baseline=timid))
    refused(saved, "wall: body/baseline/probabilities is", subs=subs)


def test_other_actions_are_refused(saved):
    subs = dict(subs_of(jam))
    body = subs["wall"].body
    few = jax.tree.map(lambda table: table[:14], body.actions)
    subs["wall"] = subs["wall"].replace(body=body.replace(actions=few))
    refused(saved, "it must be float32", subs=subs)


def test_other_obstacles_are_refused(saved):
    subs = dict(subs_of(jam))
    source = subs["obstacle"].source
    subs["obstacle"] = subs["obstacle"].replace(source=source.replace(speeds=source.speeds * 2))
    refused(saved, "obstacle: source/speeds is", subs=subs)


@pytest.mark.parametrize(
    "hidden",
    [None, 8, "8", [8, 0], [8, -6], [8, 10**9], [8.5], ["8"], [8] * 17, [10**12] * 3],
)
def test_absurd_sizes_are_refused(hidden, saved):
    edit(saved, lambda about: about["networks"]["wall"].update(hidden=hidden))
    refused(saved, "wall: hidden is .*; it must list up to 16 widths of at most 4096")


@pytest.mark.parametrize("hidden", [[], [8], [8, 4], [8, 8, 8]])
def test_sizes_other_than_the_weights_are_refused(hidden, saved):
    edit(saved, lambda about: about["networks"]["wall"].update(hidden=hidden))
    refused(saved, r"manifest\.json: .* (it must be|missing or too many)")


@pytest.mark.parametrize("activation", [None, "tanh", 3, [], {}])
def test_an_unknown_activation_is_refused(activation, saved):
    edit(saved, lambda about: about["networks"]["wall"].update(activation=activation))
    refused(saved, "wall: activation is .*; it must be one of")


@pytest.mark.parametrize("networks", [None, [], 3, {"wall": {}}, {"wall": None, "obstacle": 1}])
def test_damaged_facts_are_refused(networks, saved):
    edit(saved, lambda about: about.update(networks=networks))
    refused(saved, "hazards are|hidden is")


def test_models_without_their_hazards_are_not_saved_half(tmp_path):
    with pytest.raises(KeyError):
        artefact.save(tmp_path / "new", "jam", models_of(jam), subs_of(circuit), {})
    assert not (tmp_path / "new").exists()


def test_the_source_of_a_loaded_model_is_the_saved_one(saved):
    found = artefact.load(saved, subs_of(jam))[0]["obstacle"].source
    for field in dataclasses.fields(found):
        old = getattr(models_of(jam)["obstacle"].source, field.name)
        assert jax.tree.all(jax.tree.map(np.array_equal, getattr(found, field.name), old))
