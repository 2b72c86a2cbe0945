"""The theorems on random CMDPs, against the exact worst policy; and that mistakes are caught."""

import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_frozen_lake
import test_qlearning
from cases import S, U, counterexample_1
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from quick import compile_soon  # noqa: F401

from experiments import theorems
from rp_jax import shield
from rp_jax.tabular import (
    budgets,
    cmdp,
    exact,
    factored,
    frozen_lake,
    qlearning,
    secure,
    thresholds,
    verify,
)

ROUNDING = theorems.ROUNDING
EACH = 3_000  # instances per horizon: 12,000 CMDPs, and as many factored models


@functools.cache
def found(horizon):
    """By theorem, violations on random instances."""
    keys = jax.random.split(jax.random.fold_in(jax.random.key(7), horizon or 0), EACH)
    values = {}
    for program in theorems.programs(theorems.Config(), horizon).values():
        values |= jax.device_get(jax.jit(jax.vmap(program))(keys))
    return values


@pytest.mark.parametrize(
    "horizon",
    [pytest.param(n, marks=[pytest.mark.slow] * (n in (1, 4))) for n in theorems.HORIZONS],
)
@pytest.mark.parametrize("theorem", [*verify.CHECKS, "theorem 3"])
def test_no_theorem_is_violated(theorem, horizon):
    if horizon is None and theorem in verify.FINITE:
        assert theorem not in found(horizon)
        return
    values = found(horizon)[theorem]
    assert values.shape == (EACH,)
    assert (values <= ROUNDING).all()


def test_the_instances_cover_what_they_should():
    draw = jax.jit(jax.vmap(functools.partial(verify.draw, states=4, actions=3, horizon=3)))
    cases = draw(jax.random.split(jax.random.key(0), 2000))
    betas = np.asarray(cases.cmdp.beta)
    for beta in verify.BETAS:
        assert 100 < (betas == beta).sum() < 600
    assert ((betas > 0) & (betas < 1)).sum() > 1000
    np.testing.assert_allclose(cases.cmdp.transition.sum(-1), 1, atol=1e-12)
    absorbing = (np.asarray(cases.cmdp.transition)[:, range(4), :, range(4)] == 1).all(-1)
    assert 0.1 < absorbing.mean() < 0.4
    assert (np.asarray(cases.eta) == 0).mean() > 0.1
    action = jax.vmap(exact.threat)(cases.cmdp, cases.eta).action
    first = np.asarray(cases.x)[:, 0]
    gap = np.abs(np.asarray(action) - first[:, None, None, None]).min(axis=(1, 2, 3))
    assert (gap < 1e-15).mean() > 0.2
    assert (first == 0).mean() > 0.08
    assert (np.ptp(cases.x, axis=1) > 0).mean() > 0.1
    assert (np.asarray(cases.cmdp.start).max(axis=1) == 1).mean() > 0.2
    share = np.asarray(cases.share)
    assert 0.05 < (share < 0.2).mean() < 0.15
    inside = jax.vmap(secure.secure)(action, cases.x).secure
    assert 0.1 < np.asarray(inside).mean() < 0.95


@functools.cache
def check(name):
    return jax.jit(verify.CHECKS[name])


weights = st.sampled_from([0.0, 1.0, 2.0])
costs = st.sampled_from([0.0, 0.25, 1.0])


def rows(array):
    """Weights made to sum to one; all-zero ones to their first."""
    array = array + (array.sum(-1, keepdims=True) == 0) * (np.arange(array.shape[-1]) == 0)
    return jnp.asarray(array / array.sum(-1, keepdims=True))


@given(
    hnp.arrays(float, (3, 2, 3), elements=weights),
    hnp.arrays(float, (3, 2), elements=costs),
    hnp.arrays(float, (2, 2, 3, 2), elements=weights),
    st.sampled_from(verify.BETAS),
    st.sampled_from([0.0, 0.25, 0.5, 1.0, 3.0]),
    st.sampled_from([0.0, 0.5, 1.0, 1.5]),
)
def test_no_theorem_is_violated_by_cases_made_to_be_small(kernel, danger, etas, beta, x, share):
    case = verify.Instance(
        cmdp=cmdp.make(
            rows(kernel), np.zeros((3, 2)), danger, [0.5, 0.5, 0], gamma=1.0, beta=beta, horizon=2
        ),
        eta=rows(etas[0]),
        other=rows(etas[1]),
        x=jnp.full(2, x),
        share=jnp.asarray(share),
        noise=jnp.full((2, 3, 2), 0.5),
    )
    for name in verify.CHECKS:
        assert check(name)(case) <= ROUNDING, name


def violated(program, horizon, count=1_000):
    """How many random instances break a theorem, the program traced anew."""
    many = jax.jit(jax.vmap(lambda key: program(key, horizon=horizon)))
    values = jax.device_get(many(jax.random.split(jax.random.key(3), count)))
    counts = {name: int((each > 1e-6).sum()) for name, each in values.items()}
    print(counts)  # shown if a test fails
    return counts


def budget_alone(key, horizon):
    """Violations of the budget's checks, and of no others: they are ready sooner."""
    case = verify.draw(key, 3, 3, horizon)
    greatest = thresholds.effective_horizon(case.cmdp.beta, horizon)
    return {name: verify.CHECKS[name](case) / greatest for name in ("budget", "budget in levels")}


cmdps = functools.partial(verify.violations, states=4, actions=3)
models = functools.partial(verify.violations_of_theorem_3, states=3, actions=2, hazards=2)


def first_step_for_all(action, x, right=secure.secure):
    return right(jnp.broadcast_to(action[:1], action.shape), x)


def test_threats_of_the_first_step_for_all_steps_are_caught(monkeypatch):
    monkeypatch.setattr(secure, "secure", first_step_for_all)
    broken = violated(cmdps, 3)
    assert broken["corollary 2"] > 5
    model, eta = counterexample_1()
    allowed = secure.secure(exact.threat(model, eta).action, 0.01)
    assert allowed.admissible[1, U, 0]
    reached = secure.worst(model, allowed.admissible).state[0, S]
    assert float(reached) == pytest.approx(1.01)


def shorter(beta, horizon, right=thresholds.effective_horizon):
    return right(beta, horizon - 1)


@pytest.mark.slow
def test_one_step_too_few_in_the_effective_horizon_is_caught(monkeypatch):
    monkeypatch.setattr(thresholds, "effective_horizon", shorter)
    broken = violated(cmdps, 3)
    assert broken["corollary 1"] > 10
    assert broken["corollary 2"] > 10
    assert broken["certificate"] > 10


def late(cmdp, policy, right=exact.threat):
    found = right(cmdp, policy)
    return found._replace(action=cmdp.beta * found.action, state=cmdp.beta * found.state)


@pytest.mark.slow
def test_one_power_of_beta_too_many_is_caught(monkeypatch):
    for module in (exact, thresholds):
        monkeypatch.setattr(module, "threat", late)
    broken = violated(cmdps, 3)
    assert broken["theorem 1"] > 10
    assert broken["theorem 2"] > 10


@pytest.mark.slow
@pytest.mark.parametrize("which", ["corollary_1", "corollary_2"])
def test_factors_below_1_are_caught(monkeypatch, which):
    right = getattr(thresholds, which)
    monkeypatch.setattr(thresholds, which, lambda *given: right(*given) / 0.9)
    assert violated(cmdps, 3, count=2_000)[which.replace("_", " ")] > 5


@pytest.mark.slow
def test_charging_less_than_x_for_a_drift_is_caught(monkeypatch):
    right = verify._drifting
    wrong = lambda action, admissible, eta, x: right(action, admissible, eta, 0.9 * x)  # noqa: E731
    monkeypatch.setattr(verify, "_drifting", wrong)
    broken = violated(cmdps, 3)
    # The check takes x off the danger; less off is a bound of a smaller factor.
    assert broken["theorem 1"] > 10
    assert broken["theorem 2"] > 10


@pytest.mark.slow
def test_a_certificate_without_the_excess_is_caught(monkeypatch):
    right = thresholds._excess

    def blind(cmdp, upper):
        least, excess = right(cmdp, upper)
        return least, 0 * excess

    monkeypatch.setattr(thresholds, "_excess", blind)
    assert violated(cmdps, 3)["certificate"] > 100


def test_truncated_sub_rollouts_are_caught(monkeypatch):
    right = factored.sub_threats

    def truncated(model, policy):
        short = right(model.replace(horizon=2), policy[:2])
        return [jnp.concatenate([one, one[:1]]) for one in short]

    monkeypatch.setattr(factored, "sub_threats", truncated)
    assert violated(models, 3)["theorem 3"] > 100


def test_unmasked_targets_are_caught(monkeypatch):
    masked = types.SimpleNamespace(
        masked_sample=shield.masked_sample, masked_argmax=lambda values, _: jnp.argmax(values)
    )
    monkeypatch.setattr(qlearning, "shield", masked)
    monkeypatch.setattr(test_qlearning, "learned", test_qlearning.learned.__wrapped__)
    with pytest.raises(AssertionError, match="Not equal to tolerance"):
        test_qlearning.test_q_learning_arrives_where_value_iteration_does(None)


def test_missing_terminals_are_caught(monkeypatch):
    right = cmdp.from_table

    def endless(table, **settings):
        going = {
            s: {a: [(*move[:3], False) for move in moves] for a, moves in row.items()}
            for s, row in table.items()
        }
        return right(going, **settings)

    monkeypatch.setattr(frozen_lake, "from_table", endless)
    with pytest.raises(AssertionError):
        test_frozen_lake.test_holes_end_the_episode_or_hold_for_its_rest()


def admits_more(round_both):
    """Whether float32 admits what float64 rejects, for thresholds near threats."""
    rng = np.random.default_rng(0)
    action = rng.uniform(size=(1, 500, 5))
    action[0, 0] = [1e-46, 1e-40, 1e-38, 0.0, 1e-300]
    x = np.concatenate([np.nextafter(action[0, 1:, 0], -1), action[0, :, 1], [0.0, 0.001, 0.1]])
    exact = action[:, :, :, None] <= x
    single, limit = round_both(action, x)
    assert single.dtype == limit.dtype == np.float32
    found = jax.vmap(secure.secure, in_axes=(None, 0))(jnp.asarray(single), jnp.asarray(limit))
    admitted = np.asarray(found.admissible & found.secure[..., None])
    return (np.moveaxis(admitted, 0, -1) & ~exact).any()


def test_single_precision_never_admits_what_double_precision_rejects():
    assert not admits_more(lambda action, x: (shield.rounded_up(action), shield.rounded_down(x)))


def test_plain_rounding_to_single_precision_is_caught():
    assert admits_more(lambda action, x: (np.float32(action), np.float32(x)))


def times_beta_again(cmdp, upper, right=budgets.costs):
    """Costs of step t as if they were beta^2t of what they are: each budget divided twice."""
    found = right(cmdp, upper)
    weight = (cmdp.beta ** jnp.arange(len(upper)))[:, None, None]
    return found._replace(excess=weight * found.excess, cost=weight * found.cost)


def of_another_step(cmdp, upper, right=budgets.costs):
    """Least dangers of the next step in place of this one's."""
    later = jnp.append(upper[1:], upper[-1:], axis=0).min(axis=-1)
    found = right(cmdp, upper)
    weight = (cmdp.beta ** jnp.arange(len(upper)))[:, None, None]
    changed = weight * (found.least - later)[..., None]
    return found._replace(least=later, excess=found.excess + changed, cost=found.cost + changed)


def refunding_more(cmdp, upper, right=budgets.costs):
    found = right(cmdp, upper)
    return found._replace(cost=found.cost - 0.02)


def without_errors(cmdp, upper, right=budgets.costs):
    found = right(cmdp, upper)
    return found._replace(error=0 * found.error)


@pytest.mark.parametrize(
    "wrong", [times_beta_again, of_another_step, refunding_more, without_errors]
)
def test_wrong_costs_are_caught(monkeypatch, wrong):
    assert violated(budget_alone, 3)["budget"] == 0
    monkeypatch.setattr(budgets, "costs", wrong)
    assert violated(budget_alone, 3)["budget"] > 5


def test_budgets_that_are_not_spent_are_caught(monkeypatch):
    monkeypatch.setattr(budgets, "spend", lambda budget, cost: budget - 0 * cost)
    assert violated(budget_alone, 3)["budget"] > 100


def rounded_to_the_nearest(danger, size, most):
    return jnp.clip(jnp.round(danger / size), -most, most).astype(jnp.int32)


def test_costs_rounded_to_the_nearest_level_are_caught(monkeypatch):
    monkeypatch.setattr(budgets, "in_levels", rounded_to_the_nearest)
    assert violated(budget_alone, 3)["budget in levels"] > 100


def test_the_bounds_of_budgets_are_attained():
    keys = jax.random.split(jax.random.key(4), 1_000)
    many = jax.jit(jax.vmap(lambda key: budget_alone(key, horizon=3)))
    for name, values in many(keys).items():
        assert (np.asarray(values) > -1e-12).sum() > 20, name
