import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import jitted

from rp_jax.tabular import exact, factored, verify

drawn = jax.jit(verify.draw_factored, static_argnums=(1, 2, 3, 4))


def test_the_joint_model_moves_each_part_by_its_own_law():
    model, _ = drawn(jax.random.key(0), 3, 2, 2, 3)
    whole = factored.joint(model)
    assert whole.shape == (3, 27, 2)
    kernel = np.asarray(whole.transition).reshape(3, 3, 3, 2, 3, 3, 3)
    one, two = model.hazards
    for o, p, q, a in np.ndindex(3, 3, 3, 2):
        expected = np.einsum(
            "i,j,k->ijk", model.body[o, a], one.transition[o, a, p], two.transition[o, a, q]
        )
        np.testing.assert_allclose(kernel[o, p, q, a], expected, atol=1e-14)
        hit = max(one.hits[o, p, a], two.hits[o, q, a])
        assert np.asarray(whole.danger).reshape(3, 3, 3, 2)[o, p, q, a] == hit
    start = np.einsum("i,j,k->ijk", model.start, one.start, two.start)
    np.testing.assert_allclose(whole.start, start.ravel(), atol=1e-14)


def test_lifted_policies_see_the_agent_only():
    model, eta = drawn(jax.random.key(1), 3, 2, 2, 3)
    wide = np.asarray(factored.lifted(model, eta)).reshape(3, 3, 9, 2)
    np.testing.assert_array_equal(wide, np.broadcast_to(eta[:, :, None], wide.shape))


def test_sums_are_taken_at_each_joint_state():
    model, eta = drawn(jax.random.key(2), 3, 2, 2, 3)
    one, two = factored.sub_threats(model, eta)
    total = np.asarray(factored.summed([one, two])).reshape(3, 3, 3, 3, 2)
    np.testing.assert_allclose(total, one[:, :, :, None] + two[:, :, None], atol=1e-14)


def test_a_single_hazard_s_sum_is_its_threat():
    model, eta = drawn(jax.random.key(3), 3, 2, 1, 4)
    total = factored.summed(factored.sub_threats(model, eta))
    whole = exact.threat(factored.sub_rmdp(model, 0), factored.lifted(model, eta)).action
    np.testing.assert_array_equal(total, whole)


def test_hazards_that_never_meet_add_up_exactly():
    """Where no two events come together the union bound is no loss."""
    model, eta = drawn(jax.random.key(4), 3, 2, 2, 3)
    one, two = model.hazards
    apart = [
        one.replace(hits=one.hits.at[1:].set(0.0)),
        two.replace(hits=two.hits.at[0].set(0.0)),
    ]
    model = model.replace(hazards=apart)
    whole = exact.threat(factored.joint(model), factored.lifted(model, eta)).action
    total = factored.summed(factored.sub_threats(model, eta))
    np.testing.assert_allclose(whole, total, atol=1e-12)


def test_a_baseline_that_sees_the_obstacles_breaks_theorem_3():
    """It flees from each hazard alone, and between two into one of them."""
    stay = jnp.broadcast_to(jnp.eye(1), (1, 2, 1))
    hazards = []
    for action in range(2):  # hazard n hits if it is there (state 1) and action n is taken
        hits = jnp.zeros((1, 2, 2)).at[0, 1, action].set(1.0)
        still = jnp.broadcast_to(jnp.eye(2), (1, 2, 2, 2))
        hazards.append(factored.Hazard(still, hits, jnp.asarray([0.0, 1.0])))
    model = factored.Factored(
        body=stay,
        reward=jnp.zeros((1, 2)),
        start=jnp.ones(1),
        hazards=hazards,
        beta=jnp.ones(()),
        horizon=2,
    )
    seen = []
    for n in range(2):
        alone = factored.sub_rmdp(model, n)
        flee = jnp.eye(2)[jnp.asarray([0, 1 - n])]  # from its hazard; else action 0
        seen.append(exact.threat(alone, flee).action.reshape(2, 1, 2, 2))
    total = factored.summed(seen)
    whole = exact.least_threat(factored.joint(model)).action
    both = 3  # the state in which both hazards are there
    assert float(whole[0, both].min()) == pytest.approx(2.0)
    assert float(total[0, both].min()) == pytest.approx(1.0)


def test_algorithm_2_plans_inside_the_sum_s_sets():
    model, eta = drawn(jax.random.key(6), 3, 2, 2, 3)
    cmdp = factored.joint(model)
    np.testing.assert_array_equal(cmdp.reward, np.repeat(model.reward, 9, axis=0))
    total = factored.summed(factored.sub_threats(model, eta))
    c = float(cmdp.start @ total.min(-1)[0]) + 0.6
    x, planned = factored.approximate(model, eta, c)
    beta = float(model.beta)
    assert float(x) == pytest.approx(0.6 / (1 + beta + beta**2))
    best = np.asarray(planned.policy) > 0
    chosen = np.where(best, np.asarray(total), 0).sum(-1)
    assert ((chosen <= float(x)) | (chosen == np.asarray(total).min(-1))).all()
    done = exact.expected(cmdp, exact.threat(cmdp, planned.policy))
    assert float(done) <= c


def test_truncated_rollouts_need_their_margin():
    model, eta = drawn(jax.random.key(5), 3, 2, 2, 4)
    model = model.replace(beta=jnp.asarray(0.9))
    whole = jitted(exact.threat)(factored.joint(model), factored.lifted(model, eta)).action
    short = factored.sub_threats(model.replace(horizon=2), eta[:2])
    total = factored.summed(short)
    assert (whole[0] > total[0] + 1e-3).any()
    rest = float(sum(0.9**k for k in range(2)))  # the most that the last two steps can cost
    margin = float(factored.truncation(0.9, 2, rest))
    assert (whole[0] <= total[0] + margin + 1e-12).all()
