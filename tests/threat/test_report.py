import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401
from scipy import stats

from rp_jax.dynamics import Vehicle
from rp_jax.envs import jam
from rp_jax.envs.contract import Hazards
from rp_jax.recon.labels import exact_threat
from rp_jax.threat.model import ThreatModel, ThreatNetwork
from rp_jax.threat.report import compare, labelled_sum, predict

SUB = jam.sub_rmdps(jam.make_params())["wall"]


def test_errors_and_decisions_by_hand():
    true = np.asarray([[0.0, 0.02, 0.5], [0.01, 0.2, 1.0]])
    said = np.asarray([[0.1, 0.02, 0.005], [0.0, 0.3, 0.9]])
    found = compare(said, true, 0.01)
    error = np.asarray([0.1, 0, -0.495, -0.01, 0.1, -0.1])
    assert found["mae"] == pytest.approx(np.abs(error).mean())
    assert found["rmse"] == pytest.approx(np.sqrt((error**2).mean()))
    assert found["bias"] == pytest.approx(error.mean())
    assert (found["unsafe"], found["safe"]) == (4, 2)  # .01 itself is admissible
    assert found["unsafe_called_safe"] == pytest.approx(1 / 4)
    assert found["safe_called_unsafe"] == pytest.approx(1 / 2)
    assert (found["states_missed"], found["unsafe_states"]) == (1, 2)
    assert found["states_missed_upper95"] == pytest.approx(0.95**0.5)
    expected = stats.spearmanr([0.1, 0.02, 0.005, 0.0, 0.3, 0.9], true.ravel())[0]
    assert found["spearman"] == pytest.approx(expected)


def test_the_threshold_of_decisions_is_not_rounded_to_the_precision_of_threats():
    true = np.asarray([[0.001, 0.0], [0.001, 0.5]], np.float32)  # .0010000000475
    found = compare(true, true, 0.001)
    assert (found["unsafe"], found["unsafe_states"]) == (3, 2)
    assert (found["unsafe_called_safe"], found["states_missed"]) == (0, 0)


def test_the_order_alone_decides_the_rank_correlation():
    true = np.linspace(0, 1, 20)
    assert compare(true**3, true, 0.1)["spearman"] == pytest.approx(1)
    assert compare(1 - true, true, 0.1)["spearman"] == pytest.approx(-1)


@pytest.mark.parametrize("constant", ["said", "true", "both"])
def test_constants_have_no_rank_correlation(constant):
    rising, flat = np.linspace(0, 1, 10), np.full(10, 0.5)
    said = flat if constant in ("said", "both") else rising
    true = flat if constant in ("true", "both") else rising
    assert np.isnan(compare(said, true, 0.1)["spearman"])


def test_shares_of_nothing_are_zero():
    safe = compare(np.full(5, 0.5), np.zeros(5), 0.01)
    assert (safe["unsafe"], safe["unsafe_called_safe"], safe["safe_called_unsafe"]) == (0, 0, 1)
    unsafe = compare(np.zeros(5), np.ones(5), 0.01)
    assert (unsafe["safe"], unsafe["safe_called_unsafe"], unsafe["unsafe_called_safe"]) == (0, 0, 1)


def test_predictions_are_zero_out_of_reach_as_in_the_sum():
    network = ThreatNetwork((4,), 15)
    params = network.init(jax.random.key(0), jnp.zeros(3))
    model = ThreatModel(SUB.source, params, jnp.ones(3), jnp.zeros(()), network)
    right, up = (float(a) for a in SUB.source.window_at(jnp.asarray(0.0)).upper)
    rim = [right - 1e-6, up - 1e-6, 0]
    features = jnp.asarray([[0.0, 0.0, 0.1], [right + 0.1, 0, 0], [0, up + 0.1, 0], rim])
    threat = predict(model, features)
    inside = jnp.asarray([0, 3])
    np.testing.assert_allclose(threat[inside], model(features)[inside], rtol=1e-6)
    np.testing.assert_array_equal(threat[1:3], np.zeros((2, 15)))


def crowd(seed, count, points):
    """Agents at the origin and elsewhere, wall points about them; every third is absent."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-np.pi, np.pi, count)
    place = rng.uniform(0, 3, (count, 2))
    bodies = Vehicle(
        position=jnp.asarray(place, jnp.float32),
        heading=jnp.asarray(np.stack([np.cos(angle), np.sin(angle)], -1), jnp.float32),
        speed=jnp.asarray(rng.choice(jam.SPEEDS, count), jnp.float32),
    )
    walls = place[:, None] + rng.uniform(-0.7, 0.7, (count, points, 2))
    present = jnp.asarray(np.arange(count * points).reshape(count, points) % 3 > 0)
    return bodies, Hazards(jnp.asarray(walls, jnp.float32), present)


def test_labelled_sums_add_the_labels_of_hazards_in_reach(exact):
    bodies, hazards = crowd(0, 6, 20)
    found = labelled_sum(jax.random.key(0), bodies, hazards, SUB, exact_threat)
    features = jax.vmap(jax.vmap(SUB.source.features, (None, 0)))(bodies, hazards.state)
    each = np.asarray(exact(features.reshape(-1, 3), SUB).threat, float).reshape(6, 20, 15)
    reached = jax.vmap(jax.vmap(SUB.source.in_reach, (None, 0)))(bodies, hazards.state)
    counted = np.asarray(reached & hazards.present)
    assert 0 < counted.sum() < hazards.present.sum()  # some are outside
    assert found.shape == (6, 15)
    np.testing.assert_allclose(found, (each * counted[..., None]).sum(axis=1), atol=1e-4)
    assert found.max() > 0.1


def test_labelled_sums_are_zero_where_there_is_nothing_near():
    bodies, hazards = crowd(1, 4, 5)
    gone = hazards._replace(present=jnp.zeros((4, 5), bool))
    found = labelled_sum(jax.random.key(0), bodies, gone, SUB, exact_threat)
    np.testing.assert_array_equal(found, np.zeros((4, 15)))
