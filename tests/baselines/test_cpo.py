import dataclasses
import functools

import finite
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from jax.scipy.sparse.linalg import cg
from learning import ROLLOUT, danger_and_return
from quick import unoptimised
from scipy import optimize
from tabular import cases

from rp_jax.baselines import cpo
from rp_jax.baselines.actor_critic import DANGER, REWARD, Batch
from rp_jax.baselines.cpo import CONSTRAINED, RECOVERY, UNCONSTRAINED, CPOConfig
from rp_jax.baselines.policies import ACTORS
from rp_jax.envs import jam
from rp_jax.planning.percept import Encoded
from rp_jax.tabular import exact, oracle

CONFIG = CPOConfig(rollout=ROLLOUT)
TRACED = []

init = jax.jit(cpo.init, static_argnums=2)
improve = jax.jit(cpo.improve, static_argnums=(1, 4))


@pytest.fixture
def compile_soon():
    with unoptimised():
        yield


@functools.partial(jax.jit, static_argnums=(3, 4))
def learn(state, pmdp, limit, config, count):
    TRACED.append(config)

    def one(state, _):
        return cpo.step(state, pmdp, limit, config)

    return jax.lax.scan(one, state, None, length=count)


def policy_and_batch(name, rows=200, seed=0):
    """A small random policy, states, actions drawn from it; what is rewarding is dangerous."""
    rng = np.random.default_rng(seed)
    network = ACTORS[name](num_actions=3, scale=(1.0, 1.0), hidden=(4,))
    encoded = Encoded(
        jnp.zeros((rows, 0), jnp.uint8), jnp.asarray(rng.normal(size=(rows, 2)), float)
    )
    params = jax.jit(network.init)(jax.random.key(seed), encoded)
    params = jax.tree.map(lambda a: a + 0.3 * jnp.asarray(rng.normal(size=a.shape)), params)
    draw = jax.jit(lambda key, params: network.apply(params, encoded).sample(key))
    action = draw(jax.random.key(seed + 1), params)
    advantage = rng.normal(size=(rows, 2))
    advantage[:, DANGER] = advantage[:, REWARD] + 0.5 * advantage[:, DANGER]
    advantage = jnp.asarray(advantage, float)
    return network, params, Batch(encoded, None, action, advantage, advantage)


@pytest.mark.parametrize("name", ACTORS)
def test_the_fisher_product_is_with_the_hessian_of_the_divergence(name, x64, compile_soon):
    network, params, batch = policy_and_batch(name)
    theta, unravel = ravel_pytree(params)
    vector = jnp.asarray(np.random.default_rng(1).normal(size=len(theta)))

    @jax.jit
    def matrices(theta):
        def policy(theta):
            return network.apply(unravel(theta), batch.encoded)

        old = policy(theta)
        product = cpo.fisher_product(policy, theta, 0.1)
        solved = cg(product, vector, tol=0.0, maxiter=3 * len(theta))[0]
        hessian = jax.hessian(lambda new: jnp.mean(old.kl(policy(new))))(theta)
        return hessian, jax.vmap(product)(jnp.eye(len(theta))), solved

    hessian, found, solved = map(np.asarray, matrices(theta))
    assert np.linalg.matrix_rank(hessian, tol=1e-6) > 10
    np.testing.assert_allclose(found, hessian + 0.1 * np.eye(len(theta)), atol=1e-9)
    np.testing.assert_allclose(solved, np.linalg.solve(found, vector), rtol=1e-6, atol=1e-8)


def random_instance(seed, size=4):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(size, size))
    h = factor @ factor.T + 0.1 * np.eye(size)
    g, b = rng.normal(size=(2, size))
    s = b @ np.linalg.solve(h, b)
    delta = 0.01
    # As far from the constraint as the trust region reaches, and somewhat further.
    excess = rng.uniform(-1.5, 1.5) * np.sqrt(2 * delta * s)
    return g, b, h, excess, delta


def solution(g, b, h, excess, delta):
    v, w = np.linalg.solve(h, g), np.linalg.solve(h, b)
    numbers = [jnp.asarray(a) for a in (g @ v, g @ w, b @ w, excess)]
    along, against, case = cpo.step_lengths(*numbers, delta)
    return float(along) * v - float(against) * w, int(case)


def test_the_dual_s_solution_is_that_of_a_solver(x64):
    """All cases, from either side of the constraint."""
    met = []
    for seed in range(60):
        g, b, h, excess, delta = random_instance(seed)
        x, case = solution(g, b, h, excess, delta)
        region = {"type": "ineq", "fun": lambda x, h=h, d=delta: d - x @ h @ x / 2}
        limit = {"type": "ineq", "fun": lambda x, b=b, e=excess: -e - b @ x}
        aim, rules = (-g, [region, limit]) if case != RECOVERY else (b, [region])
        found = optimize.minimize(
            lambda x, aim=aim: 10 * aim @ x, x * 0.5, constraints=rules, method="SLSQP"
        )
        assert found.success or case == CONSTRAINED
        assert aim @ x <= aim @ found.x + 1e-5
        assert x @ h @ x / 2 <= delta * (1 + 1e-9)
        if case == RECOVERY:
            assert excess + b @ found.x > 0  # indeed no step keeps the constraint
        else:
            assert excess + b @ x <= 1e-9
        met.append((case, excess > 0))
    both = [(UNCONSTRAINED, True), (UNCONSTRAINED, False), (CONSTRAINED, True)]
    assert set(met) == {*both, (CONSTRAINED, False), (RECOVERY, True)}


@pytest.mark.parametrize("noise", [True, False])
def test_noise_does_not_pass_for_a_way_to_less_danger(noise, compile_soon):
    """The same excess is within reach where danger depends on the action, and else is not."""
    recoveries = 0
    for seed in range(8):
        network, params, batch = policy_and_batch("gaussian", rows=400, seed=seed)
        danger = batch.advantage[:, DANGER] if noise else batch.action[:, 0]
        advantage = batch.advantage.at[:, DANGER].set(danger / jnp.std(danger))
        rng = np.random.default_rng(seed)
        fresh = jnp.asarray(rng.normal(size=(400, 2)), float)  # of reward, and of danger if noise
        advantage = fresh if noise else advantage
        batch = batch._replace(advantage=advantage)
        _, update = improve(params, network, batch, jnp.asarray(0.03), CONFIG)
        recoveries += int(update.case == RECOVERY)
    assert recoveries >= 6 if noise else recoveries == 0


@pytest.mark.parametrize("excess", [-0.1, 0.0, 0.1])
def test_vanishing_gradients_give_finite_steps(excess):
    nothing, some = jnp.zeros(()), jnp.asarray(2.0)
    for q, r, s in ((nothing, nothing, nothing), (some, nothing, nothing), (some, some, some)):
        along, against, _ = cpo.step_lengths(q, r, s, jnp.asarray(excess), 0.01)
        assert np.isfinite(along)
        assert np.isfinite(against)


@pytest.mark.parametrize("name", ACTORS)
@pytest.mark.parametrize("excess", [-1.0, -0.02, 0.02, 1.0])
def test_an_update_stays_in_the_trust_region_and_goes_the_right_way(name, excess, compile_soon):
    network, params, batch = policy_and_batch(name)
    new, update = improve(params, network, batch, jnp.asarray(excess), CONFIG)
    assert update.accepted
    # The advantages are noise: two halves of the Gaussian's disagree that .02 is within reach.
    near = {"gaussian": RECOVERY, "categorical": CONSTRAINED}[name]
    expected = {-1.0: UNCONSTRAINED, -0.02: CONSTRAINED, 0.02: near, 1.0: RECOVERY}
    assert update.case == expected[excess]
    old, after = (network.apply(p, batch.encoded) for p in (params, new))
    kl = float(jnp.mean(old.kl(after)))
    assert kl == pytest.approx(float(update.kl), rel=1e-4)
    assert CONFIG.divergence / 4 < kl <= CONFIG.divergence
    ratio = np.exp(after.log_prob(batch.action) - old.log_prob(batch.action))
    advantage = batch.advantage - batch.advantage.mean(axis=0, keepdims=True)
    change = (ratio[:, None] * advantage).mean(axis=0)
    assert change[DANGER] <= max(-excess, 0) + 1e-6
    if excess <= 0:
        assert change[REWARD] > 0.005
    if excess > 0:
        assert change[DANGER] < -0.01


def test_where_no_step_will_do_the_policy_stays(compile_soon):
    network, params, batch = policy_and_batch("gaussian")
    config = dataclasses.replace(CONFIG, backtracks=1, divergence=1e4)  # far beyond any validity
    new, update = improve(params, network, batch, jnp.asarray(0.0), config)
    assert not update.accepted
    assert update.kl == 0
    for a, b in zip(jax.tree.leaves(new), jax.tree.leaves(params), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_recovery_reduces_the_danger():
    model = finite.bandit([0.0, 1.0], [0.0, 1.0])
    pmdp = finite.pmdp_of(model)
    state = init(jax.random.key(0), pmdp, CONFIG)
    state.actor["params"]["logits_out"]["bias"] = jnp.asarray([-1.0, 1.0])  # a dangerous start
    state, metrics = learn(state, pmdp, jnp.asarray(0.05), CONFIG, 60)
    danger = np.asarray(metrics.rollout.danger / metrics.rollout.episodes)
    assert danger[0] > 0.8
    assert (np.asarray(metrics.update.case[1:15]) == RECOVERY).all()  # once the critic knows
    assert danger[15] < danger[0] - 0.25
    assert danger[-5:].mean() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 3])
def test_on_a_finite_cmdp_it_keeps_the_limit_and_comes_near_the_optimum(seed):
    model = cases.random_cmdp(seed, gamma=1.0, beta=1.0)
    least = float(exact.expected(model, exact.least_threat(model)))
    free = oracle.optimum(model, np.inf)
    limit = 0.6 * least + 0.4 * free.danger
    best = oracle.optimum(model, limit)
    assert free.value > best.value + 0.1  # the limit costs something
    pmdp = finite.pmdp_of(model)
    state = init(jax.random.key(1), pmdp, CONFIG)
    state, _ = learn(state, pmdp, jnp.asarray(limit, jnp.float32), CONFIG, 60)
    danger, value = danger_and_return(model, pmdp, state.actor)
    assert danger < limit + 0.02
    assert value > best.value - 0.1


@pytest.mark.slow
def test_limits_and_seeds_side_by_side_learn_what_each_learns_alone(compile_soon):
    model = cases.random_cmdp(3, gamma=1.0, beta=1.0)
    pmdp = finite.pmdp_of(model)
    config = dataclasses.replace(CONFIG, rollout=dataclasses.replace(ROLLOUT, num_envs=8, length=8))
    keys, limits = jax.random.split(jax.random.key(2)), jnp.asarray([0.1, 1.0])
    begun = jax.vmap(init, (0, None, None))(keys, pmdp, config)
    many = jax.jit(jax.vmap(learn, (0, None, 0, None, None)), static_argnums=(3, 4))
    _, metrics = many(begun, pmdp, limits, config, 3)
    before = len(TRACED)
    for i in range(2):
        _, mine = learn(init(keys[i], pmdp, config), pmdp, limits[i], config, 3)
        theirs = jax.tree.map(lambda a, i=i: a[i], metrics)
        np.testing.assert_allclose(mine.rollout.score, theirs.rollout.score, rtol=1e-3)
        np.testing.assert_array_equal(mine.update.case, theirs.update.case)
        np.testing.assert_allclose(mine.update.kl, theirs.update.kl, rtol=0.02)
    assert len(TRACED) <= before + 1  # the two limits share a compilation


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"divergence": 0.0}, "divergence"),
        ({"damping": -1.0}, "damping"),
        ({"products": 0}, "products"),
        ({"backtracks": 0}, "backtracks"),
        ({"shrink": 1.5}, "shrink"),
        ({"rollout": dataclasses.replace(ROLLOUT, gamma=2.0)}, r"rollout\.gamma"),
    ],
)
def test_bad_settings_are_named(change, field):
    CONFIG.validate("cpo")
    with pytest.raises(ValueError, match=rf"^cpo\.{field} is .*must"):
        dataclasses.replace(CONFIG, **change).validate("cpo")


def test_a_batch_of_a_real_task_finds_a_step():
    """As large as Jam's: compiled without these options, its products are wrong on a CPU."""
    rng = np.random.default_rng(0)
    rows = 6400
    network = ACTORS["categorical"](num_actions=15, scale=jam.SCALE)
    seen = Encoded(
        jnp.asarray(rng.integers(0, 256, (rows, 45)), jnp.uint8),
        jnp.asarray(rng.normal(size=(rows, 36)), jnp.float32),
    )
    advantage = jnp.asarray(rng.normal(size=(rows, 2)), jnp.float32)
    actions = jnp.asarray(rng.integers(0, 15, rows))
    batch = Batch(seen, None, actions, advantage, advantage)
    params = jax.jit(network.init)(jax.random.key(0), seen)
    update = jax.jit(
        lambda params, batch: cpo.improve(params, network, batch, jnp.asarray(-1.0), CPOConfig())[
            1
        ],
        compiler_options=cpo.compiler_options(),
    )(params, batch)
    assert update.accepted
    assert 0.003 < update.kl <= 0.01
