"""Nan and infinity, put in everywhere: found within the chunk, named, and never clipped."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import optax
import probe
import pytest
from quick import compile_soon  # noqa: F401

from rp_jax import evaluation, rare, shield
from rp_jax.baselines import actor_critic
from rp_jax.baselines.actor_critic import ActorCriticConfig
from rp_jax.baselines.cpo import CPOConfig
from rp_jax.baselines.pid_lagrangian import PIDConfig
from rp_jax.planning import dqn, loop
from rp_jax.planning.loop import LoopConfig
from rp_jax.planning.percept import encode
from rp_jax.planning.pmdp import PMDP
from rp_jax.recon import labels
from rp_jax.runs import policy_gradient
from rp_jax.threat import build
from rp_jax.threat.fit import Dataset, FitConfig

PARAMS = probe.make_params()
CONFIG = LoopConfig(steps=64, num_envs=8, batch=8, n_step=1, replay=64, replay_start=8)
WRONG = [np.nan, np.inf, -np.inf]
each_wrong = pytest.mark.parametrize(  # nan, which compares with nothing, is the one to miss
    "wrong", [np.nan, *(pytest.param(wrong, marks=pytest.mark.slow) for wrong in WRONG[1:])]
)
each_learner = pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.slow] * (n != "CPO")) for n in policy_gradient.LEARNERS],
)


@pytest.fixture(autouse=True)
def allow_rank_promotion():
    """Flashbax's sampling needs it."""
    with jax.numpy_rank_promotion("allow"):
        yield


def env_with(**changed):
    """The corridor with some functions replaced."""
    return types.SimpleNamespace(**{**vars(probe), **changed})


def seen_with(wrong, place):
    def observe(state, params):
        observation = probe.observe(state, params)
        return observation.at[place].set(jnp.where(state.time == 2, wrong, observation[place]))

    return env_with(observe=observe)


def paid_with(wrong):
    def step(key, state, action, params):
        reached, outcome = probe.step(key, state, action, params)
        reward = jnp.where(reached.time == 2, wrong, outcome.reward)
        return reached, dataclasses.replace(outcome, reward=reward)

    return env_with(step=step)


def model_with(wrong):
    """One that says `wrong` of one action: the last one, where the pit is far."""
    model = probe.threat_model(PARAMS)
    bias = model.params["params"]["Dense_0"]["bias"]
    weights = {"params": {"Dense_0": {**model.params["params"]["Dense_0"]}}}
    weights["params"]["Dense_0"]["bias"] = bias.at[2].set(wrong)
    return {"pit": model.replace(params=weights)}


def trained(pmdp, config=CONFIG):
    # Functions of their own: nothing is taken from before a part was replaced.
    init = jax.jit(lambda key, pmdp: loop.init(key, pmdp, config))
    advance = jax.jit(lambda state, pmdp: loop.chunk(state, pmdp, config, 4))
    state, metrics = init(jax.random.key(0), pmdp)
    state, new = advance(state, pmdp)
    loop.check(state.learner.params, jax.tree.map(lambda a, b: np.asarray(a + b), metrics, new))


def played(pmdp):
    values = lambda percept: jnp.zeros(percept.threat.shape)  # noqa: E731
    run = jax.jit(lambda key, pmdp: evaluation.run_episodes(key, pmdp, values, 8, batch=8))
    evaluation.check(jax.tree.map(np.asarray, run(jax.random.key(0), pmdp)), "N=8")


def test_what_is_sound_passes():
    pmdp = probe.make_pmdp(probe, PARAMS)
    trained(pmdp)
    played(pmdp)


@pytest.mark.parametrize(
    ("wrong", "place"),
    [
        (np.inf, 0),
        pytest.param(np.nan, 7, marks=pytest.mark.slow),
        pytest.param(-np.inf, 17, marks=pytest.mark.slow),
    ],
)
def test_observations_are_named(wrong, place):
    pmdp = probe.make_pmdp(seen_with(wrong, place), PARAMS)
    with pytest.raises(FloatingPointError, match=r"^N=8: observations of \d+ steps are nan"):
        played(pmdp)
    with pytest.raises(FloatingPointError, match=r"^planning: observations of \d+ steps"):
        trained(pmdp)


@pytest.mark.parametrize("wrong", WRONG)
def test_a_lidar_that_is_no_number_is_not_hidden_in_bytes(wrong):
    found = encode(jnp.asarray([0.5, wrong, 0.5, 0.5, 7.0]), 4, 2)
    assert np.isnan(found.rest).all()
    assert np.isfinite(encode(jnp.asarray([0.5, 0.5, 0.5, 0.5, 7.0]), 4, 2).rest).all()


class Threatened(PMDP):
    """One state's threats hold a number that is none, whatever they come from."""

    def _total(self, states, alive=None):
        there = (states.time == 2)[:, None] & (jnp.arange(3) == 1)
        wrong = self.insecure_penalty  # which serves for nothing else here
        return jnp.where(there, wrong, jnp.zeros((states.time.shape[0], 3)))


@each_wrong
def test_threats_are_named(wrong):
    like = probe.make_pmdp(probe, PARAMS)
    fields = {name: getattr(like, name) for name in like.__dataclass_fields__}
    pmdp = Threatened(**{**fields, "insecure_penalty": jnp.float32(wrong)})
    with pytest.raises(FloatingPointError, match=r"^planning: threats of \d+ steps"):
        trained(pmdp)
    with pytest.raises(FloatingPointError, match=r"^N=8: threats of \d+ steps"):
        played(pmdp)
    values = lambda percept: jnp.zeros(percept.threat.shape)  # noqa: E731
    stage, paths = rare.compiled(values), rare.begin(jax.random.key(0), pmdp, 8)
    with pytest.raises(FloatingPointError, match=r"^rare: observations or threats of \d paths"):
        stage(jax.random.key(1), paths, pmdp, jnp.float32(np.inf))


def test_threats_of_a_model_are_named():
    pmdp = probe.make_pmdp(probe, PARAMS, models=model_with(np.nan))
    with pytest.raises(FloatingPointError, match=r"^planning: threats of \d+ steps"):
        trained(pmdp)
    with pytest.raises(FloatingPointError, match=r"^N=8: threats of \d+ steps"):
        played(pmdp)


def test_a_threat_that_is_nan_is_inadmissible_and_a_row_of_nothing_else_is_found():
    found = shield.shield(jnp.asarray([0.2, jnp.nan, jnp.inf]), 0.5)
    assert found.admissible.tolist() == [True, False, False]
    found = shield.shield(jnp.asarray([0.9, jnp.nan, 0.7]), 0.5)
    assert found.admissible.tolist() == [False, False, True]
    assert not found.secure
    nothing = model_with(np.nan)["pit"]
    weights = jax.tree.map(lambda a: jnp.full_like(a, jnp.nan), nothing.params)
    pmdp = probe.make_pmdp(probe, PARAMS, models={"pit": nothing.replace(params=weights)})
    with pytest.raises(FloatingPointError, match=r"^planning: threats"):
        trained(pmdp)
    with pytest.raises(FloatingPointError, match=r"^N=8: threats"):
        played(pmdp)


@each_wrong
def test_rewards_are_named(wrong):
    pmdp = probe.make_pmdp(paid_with(wrong), PARAMS)
    with pytest.raises(FloatingPointError, match=r"^planning: rewards of \d+ steps"):
        trained(pmdp)
    with pytest.raises(FloatingPointError, match=r"^N=8: returns: \d of 8 numbers are nan"):
        played(pmdp)


@each_wrong
def test_losses_are_named(wrong, monkeypatch):
    huber = optax.huber_loss
    monkeypatch.setattr(optax, "huber_loss", lambda *of: huber(*of).at[0].set(wrong))
    with pytest.raises(FloatingPointError, match=r"^planning: losses: 1 of 1 numbers"):
        trained(probe.make_pmdp(probe, PARAMS))


def faulty(wrong, adam=optax.adam(1e-3)):  # noqa: B008
    """An optimiser that meets a gradient that is no number."""

    def update(grads, state, params=None):
        first, *rest = jax.tree.leaves(grads)
        broken = [first.at[(0,) * first.ndim].set(wrong), *rest]
        return adam.update(jax.tree.unflatten(jax.tree.structure(grads), broken), state, params)

    return optax.GradientTransformation(adam.init, update)


@each_wrong
def test_gradients_are_named(wrong, monkeypatch):
    monkeypatch.setattr(dqn, "optimiser", lambda *_: faulty(wrong))
    one = dataclasses.replace(CONFIG)
    with pytest.raises(FloatingPointError, match=r"^planning: (weights, after a gradient|losses)"):
        trained(probe.make_pmdp(probe, PARAMS), one)


def learns(name, env):
    rollout = ActorCriticConfig("categorical", 8, 16, minibatches=2)
    config = {"CPO": CPOConfig, "PID-Lagrangian": PIDConfig}[name](rollout)
    policy_gradient.learn_policies(
        jax.random.key(0), env, PARAMS, name, c=0.1, config=config, steps=256
    )


@each_learner
def test_policy_gradients_stop_at_rewards_that_are_none(name):
    """CPO would go on in silence: its line search accepts no step, and its policy stays finite."""
    with pytest.raises(FloatingPointError, match=rf"^{name}: rewards of \d+ steps are nan"):
        learns(name, paid_with(np.nan))


@each_learner
def test_policy_gradients_name_observations_and_what_is_learned(name, monkeypatch):
    with pytest.raises(FloatingPointError, match=rf"^{name}: observations of \d+ steps are nan"):
        learns(name, seen_with(np.inf, 17))
    monkeypatch.setattr(actor_critic.optax, "adam", lambda *_, **__: faulty(np.nan))
    with pytest.raises(FloatingPointError, match=f"^{name}: values' weights"):
        learns(name, probe)


@pytest.mark.parametrize("wrong", WRONG[:2])
def test_labels_are_named(wrong):
    sub = probe.sub_rmdps(PARAMS)["pit"]

    def estimator(key, body, hazard, sub):
        found = labels.exact_threat(key, body, hazard, sub)
        return found.replace(threat=found.threat.at[1].set(wrong))

    body, hazard = jax.vmap(lambda key: sub.source.sample(key, sub.body))(
        jax.random.split(jax.random.key(0), 4)
    )
    with pytest.raises(FloatingPointError, match=r"^labels: 4 of 12 numbers are nan or infinite"):
        labels.label(jax.random.key(0), body, hazard, sub, estimator)


def fitted(monkeypatch, change=None, wrong=0.5):
    sub = probe.sub_rmdps(PARAMS)["pit"]
    features = jnp.ones((40, 3)).at[:, 0].set(jnp.arange(40.0))
    data = Dataset(features, jnp.full((40, 3), 0.5).at[3, 1].set(wrong))
    if change:
        monkeypatch.setattr(build.fit, "optimiser", lambda _: change)
    config = FitConfig(hidden=(4,), steps=8, batch=64, validation=0.05)
    jax.clear_caches()  # of the fit with another optimiser
    return build.fitted(jax.random.key(0), sub, data, config)


@each_wrong
def test_the_losses_and_gradients_of_a_fit_are_named(wrong, monkeypatch):
    fitted(monkeypatch)
    with pytest.raises(FloatingPointError, match=r"^fit: (losses|weights):"):
        fitted(monkeypatch, wrong=wrong)
    with pytest.raises(FloatingPointError, match=r"^fit: (losses|weights):"):
        fitted(monkeypatch, change=faulty(wrong))
