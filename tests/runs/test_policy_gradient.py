"""CPO and PID-Lagrangian as jobs, on the corridor."""

import dataclasses
import json

import jax
import numpy as np
import probe
import pytest
from quick import compile_soon, stopped_after  # noqa: F401

from rp_jax import evaluation, storage
from rp_jax.baselines.actor_critic import ActorCriticConfig
from rp_jax.baselines.cpo import CPOConfig
from rp_jax.baselines.pid_lagrangian import PIDConfig
from rp_jax.runs import evaluate, policy_gradient
from rp_jax.streams import Stream, key_of, numbered

ROLLOUT = ActorCriticConfig("categorical", 8, 16, minibatches=2)
CONFIGS = {"CPO": CPOConfig(ROLLOUT), "PID-Lagrangian": PIDConfig(ROLLOUT)}


def learn(method, folder=None, **changes):
    settings = {"c": 0.1, "seeds": [0, 1], "config": CONFIGS.get(method), "steps": 1024}
    params = probe.make_params()
    return policy_gradient.learn_policies(
        jax.random.key(0), probe, params, method, folder=folder, **{**settings, **changes}
    )


@pytest.mark.parametrize("method", ["CPO", pytest.param("PID-Lagrangian", marks=pytest.mark.slow)])
def test_an_interrupted_job_goes_on_to_the_same_bits(method, tmp_path, monkeypatch):
    def untimed(folder):
        lines = (folder / "metrics.jsonl").read_text().splitlines()
        return [{k: v for k, v in json.loads(x).items() if k != "seconds"} for x in lines]

    apart, at_once = tmp_path / "apart", tmp_path / "at_once"
    with stopped_after(3, monkeypatch), pytest.raises(KeyboardInterrupt, match="3 done"):
        learn(method, apart)
    assert any((apart / "checkpoints" / storage.file_name(method)).iterdir())
    found, whole = learn(method, apart), learn(method, at_once)
    jax.tree.map(np.testing.assert_array_equal, found.weights, whole.weights)
    assert untimed(apart) == untimed(at_once)
    assert not (apart / "checkpoints").exists()


def test_what_is_finished_is_read_again_and_nothing_else_is_taken_for_it(tmp_path, monkeypatch):
    made = learn("CPO", tmp_path)
    monkeypatch.setattr(policy_gradient, "_learned", lambda *_: pytest.fail("it was learned"))
    read = learn("CPO", tmp_path)
    jax.tree.map(np.testing.assert_array_equal, read.weights, made.weights)
    assert read.seconds == made.seconds
    assert [row["steps"] for row in read.history] == [row["steps"] for row in made.history]
    for odd, change in {
        "c": {"c": 0.2},
        "steps": {"steps": 2048},
        "members": {"seeds": 1},
        "config: damping": {"config": dataclasses.replace(CONFIGS["CPO"], damping=0.5)},
        "penalty": {"penalty": 1.0},
    }.items():
        with pytest.raises(ValueError, match=rf"^folder is .*; its {odd} is "):
            learn("CPO", tmp_path, **change)


def test_a_policy_does_not_depend_on_those_beside_it():
    both, alone = learn("PID-Lagrangian"), learn("PID-Lagrangian", seeds=[1])
    assert (len(both), len(alone)) == (2, 1)
    second = jax.tree.map(lambda a: a[1], both.weights)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b[0], atol=1e-4), second, alone.weights)


def test_policies_are_evaluated_by_their_modes(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluate, "ROUND", 8)
    policies, params = learn("CPO"), probe.make_params(slip=0.5)
    key = jax.random.key(3)
    judge = lambda: policy_gradient.evaluate_policies(  # noqa: E731
        key, policies, params, episodes=12, penalty=2.0, name="slip .5", folder=tmp_path
    )
    table = judge()
    assert [(row["method"], row["seed"], row["variant"]) for row in table] == [
        ("CPO", seed, "slip .5") for seed in (0, 1)
    ]
    assert all(row["x"] == float("inf") for row in table)
    own = numbered(key_of(key, Stream.EVALUATION), [1])[0]
    weights = jax.tree.map(lambda a: a[1], policies.weights)
    there, policy = policies.pmdp.replace(params=params), policies.players.policy(weights)
    at_once = evaluation.play_episodes(own, there, policy, 12, batch=8)
    assert table[1]["return_mean"] == pytest.approx(
        float((at_once.score - 2.0 * at_once.danger).mean())
    )
    with stopped_after(1, monkeypatch), pytest.raises(KeyboardInterrupt):
        judge()
    assert storage.plain(judge().rows) == storage.plain(table.rows)
    assert policy_gradient.time_policies(key, policies, params).wall > 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "SAC"}, "method is 'SAC'; it must be one of 'CPO', 'PID-Lagrangian'"),
        ({"config": PIDConfig(ROLLOUT)}, "config is .*; for CPO it must be a CPOConfig"),
        ({"config": dataclasses.replace(CONFIGS["CPO"], shrink=0.0)}, "config.shrink is 0"),
        ({"c": -1.0}, "c is -1.0"),
        ({"steps": 0}, "steps is 0"),
        ({"seeds": 0}, "seeds is 0"),
        ({"penalty": -1.0}, "penalty is -1.0"),
        ({"learning_penalty": float("inf")}, "learning_penalty is inf"),
    ],
)
def test_bad_settings_are_named(changes, message, tmp_path):
    settings = {"method": "CPO", **changes}
    with pytest.raises(ValueError, match=f"^{message}"):
        learn(settings.pop("method"), tmp_path / "new", **{"config": CONFIGS["CPO"], **settings})
    assert not (tmp_path / "new").exists()


def test_a_world_that_takes_no_continuous_actions_is_named(monkeypatch):
    def step(key, state, action, params):
        return probe_step(key, state, jax.numpy.zeros((3,))[action].astype(int), params)

    probe_step = probe.step
    monkeypatch.setattr(probe, "step", step)
    says = r"config\.rollout\.policy is 'gaussian'; it must be 'categorical' in probe, whose step"
    with pytest.raises(ValueError, match=says):
        learn("CPO", config=CPOConfig(dataclasses.replace(ROLLOUT, policy="gaussian")))
