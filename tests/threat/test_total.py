import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax.dynamics import Vehicle
from rp_jax.envs import jam
from rp_jax.envs.contract import Hazards
from rp_jax.threat.model import ThreatModel, ThreatNetwork
from rp_jax.threat.total import CHUNK, total_threat

PARAMS = jam.make_params(6)
SUBS = jam.sub_rmdps(PARAMS)
MOST = 600  # states; their hazards fill several chunks
FEW = 64  # states, where one chunk does
total = jax.jit(total_threat)


def random_models(seed):
    """Untrained networks of two depths, inputs and outputs far enough apart to tell rows apart."""
    models = {}
    for i, (kind, hidden, width) in enumerate((("wall", (64, 32), 3), ("obstacle", (32,), 6))):
        network = ThreatNetwork(hidden, 15, "silu")
        params = network.init(jax.random.key(10 * seed + i), jnp.zeros(width))
        params = jax.tree.map(lambda a: 2.0 * a, params)
        scale = jnp.full(width, 3.0)
        models[kind] = ThreatModel(SUBS[kind].source, params, scale, jnp.asarray(-3.0), network)
    return models


def random_states(seed, count):
    """Agents and obstacles anywhere in the room; one obstacle in three is absent."""
    rng = np.random.default_rng(seed)

    def vehicles(*shape):
        angle = rng.uniform(-np.pi, np.pi, shape)
        return Vehicle(
            position=jnp.asarray(rng.uniform(0, 3, (*shape, 2)), jnp.float32),
            heading=jnp.asarray(np.stack([np.cos(angle), np.sin(angle)], axis=-1), jnp.float32),
            speed=jnp.asarray(rng.uniform(-0.1, 0.1, shape), jnp.float32),
        )

    bodies, others = vehicles(count), vehicles(count, 6)
    walls = jax.jit(jax.vmap(PARAMS.walls_in_reach.near))(bodies.position)
    return bodies, {
        "wall": Hazards(walls, walls[..., 0] < 100),
        "obstacle": Hazards(others, jnp.asarray(rng.random((count, 6)) < 2 / 3)),
    }


MODELS, (AGENTS, HAZARDS) = random_models(0), random_states(0, MOST)
many = functools.cache(lambda: np.asarray(total(MODELS, AGENTS, HAZARDS)))
many_terms = functools.cache(lambda: terms(MODELS, AGENTS, HAZARDS))


def some(tree, rows):
    return jax.tree.map(lambda a: a[rows], tree)


def terms(models, bodies, hazards):
    """By state, the float32 threats (k, A) of the hazards that count, one kind after another.

    Every network call has as many rows as the packed one, so that the terms are the same bits.
    """
    count = len(bodies.speed)
    found = [[] for _ in range(count)]
    for kind in sorted(hazards):
        model, group = models[kind], hazards[kind]
        features = jax.jit(jax.vmap(jax.vmap(model.source.features, (None, 0))))
        features = np.asarray(features(bodies, group.state))
        present = np.asarray(group.present)
        reached = jax.jit(jax.vmap(jax.vmap(model.source.in_reach, (None, 0))))
        reached = np.asarray(reached(bodies, group.state))
        rows = []
        for i in range(count):
            for n in range(present.shape[1]):
                if present[i, n] and reached[i, n]:
                    rows.append((i, features[i, n]))
        for start in range(0, len(rows), CHUNK):
            part = rows[start : start + CHUNK]
            packed = np.zeros((CHUNK, features.shape[-1]), np.float32)
            packed[: len(part)] = [row for _, row in part]
            for (i, _), threat in zip(part, np.asarray(model(jnp.asarray(packed))), strict=False):
                found[i].append(threat)
    return [np.asarray(f).reshape(-1, 15) for f in found]


def test_the_states_are_a_fair_trial():
    counts = np.asarray([len(t) for t in many_terms()])
    assert counts.min() < 5 < 25 < counts.max()
    assert counts.sum() > CHUNK  # several calls of a network
    whole = np.concatenate(many_terms())
    assert whole.min() < 0.01
    assert whole.max() > 0.9


@pytest.mark.parametrize("batch", [1, 7, FEW, MOST])
def test_it_is_the_sum_over_the_hazards_in_reach(batch):
    rows = np.random.default_rng(batch).choice(MOST, batch, replace=False)
    found = total(MODELS, some(AGENTS, rows), some(HAZARDS, rows))
    expected = np.stack([many_terms()[i].astype(float).sum(axis=0) for i in rows])
    assert found.shape == (batch, 15)
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-12)


@pytest.mark.parametrize("seed", [1, 2])
def test_it_is_so_for_other_models_and_states(seed):
    models, (bodies, hazards) = random_models(seed), random_states(seed, FEW)
    expected = [t.astype(float).sum(axis=0) for t in terms(models, bodies, hazards)]
    found = total(models, bodies, hazards)
    np.testing.assert_allclose(found, np.stack(expected), rtol=2e-5, atol=1e-12)


def test_it_is_rounded_up():
    found = many().astype(float)
    exact = np.stack([t.astype(float).sum(axis=0) for t in many_terms()])
    assert (found >= exact).all()


@pytest.mark.parametrize("batch", [1, 7, FEW])
def test_a_row_does_not_depend_on_the_batch_around_it(batch):
    whole = many()
    for start in (0, 17, MOST - batch):
        rows = np.arange(start, start + batch)
        part = total(MODELS, some(AGENTS, rows), some(HAZARDS, rows))
        np.testing.assert_array_equal(part, whole[rows])


def test_a_row_does_not_depend_on_its_place():
    whole = many()
    order = np.random.default_rng(3).permutation(MOST)
    shuffled = total(MODELS, some(AGENTS, order), some(HAZARDS, order))
    np.testing.assert_array_equal(shuffled, whole[order])


def test_absent_hazards_count_nothing():
    bodies, hazards = random_states(4, FEW)
    obstacles, walls = hazards["obstacle"], hazards["wall"]
    gone = {**hazards, "obstacle": obstacles._replace(present=jnp.zeros((FEW, 6), bool))}
    alone = total({"wall": MODELS["wall"]}, bodies, {"wall": walls})
    np.testing.assert_allclose(total(MODELS, bodies, gone), alone, rtol=1e-5)
    none = {**gone, "wall": walls._replace(present=jnp.zeros_like(walls.present))}
    np.testing.assert_array_equal(total(MODELS, bodies, none), np.zeros((FEW, 15)))


@pytest.mark.parametrize("nowhere", [np.nan, np.inf])
def test_where_absent_hazards_stand_makes_no_difference(nowhere):
    bodies, hazards = random_states(5, FEW)
    others = hazards["obstacle"]
    away = jnp.where(others.present[..., None], others.state.position, nowhere)
    lost = others._replace(state=others.state.replace(position=away))
    np.testing.assert_array_equal(
        total(MODELS, bodies, {**hazards, "obstacle": lost}), total(MODELS, bodies, hazards)
    )


def test_hazards_out_of_reach_count_nothing():
    model = {"wall": MODELS["wall"]}
    window = SUBS["wall"].source.window_at(jnp.zeros(()))
    body = Vehicle(jnp.zeros((1, 2)), jnp.asarray([[1.0, 0.0]]), jnp.zeros(1))

    def at(x, y):
        place = jnp.asarray([[[x, y]]], jnp.float32)
        return total(model, body, {"wall": Hazards(place, jnp.ones((1, 1), bool))})

    (left, down), (right, up) = np.asarray(window.lower), np.asarray(window.upper)
    rim = ((right, 0.0), (left, 0.0), (0.0, up), (0.0, down), (right, up))
    for x, y in np.asarray(rim) * (1 - 1e-6):
        assert (at(x, y) > 0).all()
    for x, y in np.asarray(rim) * (1 + 1e-5):
        np.testing.assert_array_equal(at(x, y), np.zeros((1, 15)))


def test_more_hazards_are_never_less_dangerous():
    bodies, hazards = random_states(6, FEW)
    before = np.zeros((FEW, 15))
    for count in range(7):
        present = jnp.broadcast_to(jnp.arange(6) < count, (FEW, 6))
        group = hazards["obstacle"]._replace(present=present)
        now = np.asarray(total(MODELS, bodies, {**hazards, "obstacle": group}))
        assert (now >= before).all()
        before = now


def test_a_kind_without_places_counts_nothing():
    bodies, hazards = random_states(7, FEW)
    empty = Hazards(some(hazards["obstacle"].state, np.s_[:, :0]), jnp.zeros((FEW, 0), bool))
    alone = total({"wall": MODELS["wall"]}, bodies, {"wall": hazards["wall"]})
    both = total(MODELS, bodies, {"wall": hazards["wall"], "obstacle": empty})
    np.testing.assert_allclose(both, alone, rtol=1e-5)


def test_a_missing_model_is_named():
    with pytest.raises(ValueError, match=r"no threat model for obstacle; there are .* for wall"):
        total_threat({"wall": MODELS["wall"]}, AGENTS, HAZARDS)


@pytest.mark.parametrize("models_too", [False, True])
def test_it_works_under_vmap_over_seeds(models_too):
    seeds = [random_states(seed, FEW) for seed in (8, 9, 10)]
    bodies, hazards = jax.tree.map(lambda *a: jnp.stack(a), *seeds)
    models = [random_models(seed) if models_too else MODELS for seed in (0, 1, 2)]
    given = jax.tree.map(lambda *a: jnp.stack(a), *models) if models_too else MODELS
    axes = (0 if models_too else None, 0, 0)
    found = jax.jit(jax.vmap(total_threat, axes))(given, bodies, hazards)
    for i in range(3):
        np.testing.assert_allclose(found[i], total(models[i], *seeds[i]), rtol=1e-5, atol=1e-9)
