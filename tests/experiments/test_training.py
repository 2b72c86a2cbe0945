"""Training runs in chunks, with a learner that only counts."""

import json

import jax
import numpy as np
import probe
import pytest
from quick import compile_soon, stopped_after  # noqa: F401

from experiments import console, policy_gradient, tasks, training
from rp_jax.baselines.actor_critic import ActorCriticConfig
from rp_jax.baselines.cpo import CPOConfig
from rp_jax.baselines.pid_lagrangian import PIDConfig
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints, chunks_of
from rp_jax.planning.loop import LoopConfig

COUNTED = ("steps", "episodes", "score", "danger", "crashes", "goals")


MEMBERS = [training.Member(3, 0.1, 0.0), training.Member(4, 0.1, 0.0)]


@pytest.mark.parametrize("units", [1, 7, 30, 31, 1000])
def test_chunks_hold_all_units_and_few_more(units):
    chunks, length = chunks_of(units, training.CHUNKS)
    assert chunks <= training.CHUNKS
    assert units <= chunks * length < units + length


def learn(folder, checkpoints=NO_CHECKPOINTS, chunks=4, fails_at=None):
    """Member i has i episodes a chunk, each of 10 points and half a crash."""
    each = np.asarray([0.0, 1.0], np.float32)
    blank = {name: np.zeros((chunks, 2), np.float32) for name in COUNTED}

    def step(i, state):
        sums = (each + 5, each, 10 * each, each / 2, each, 0 * each)
        return state + 1, dict(zip(COUNTED, sums, strict=True))

    def check(weights, sums):
        assert sums["steps"].shape == (2,)
        if weights == fails_at:
            raise FloatingPointError(f"chunk {fails_at}")

    learners = training.Learners(
        MEMBERS, ["a", "b"], 4.0, folder, lambda sums: {"per step": sums["score"] / sums["steps"]}
    )
    with console.progress("counting") as bar:
        state = np.asarray(0)
        return training.learn(learners, state, blank, step, check, lambda s: s, bar, checkpoints)


def test_each_chunk_and_member_has_a_row(tmp_path):
    weights, rows, seconds = learn(tmp_path)
    assert weights == 4
    assert seconds >= 0
    assert [(row["seed"], row["method"]) for row in rows] == 4 * [(3, "a"), (4, "b")]
    assert [row["steps"] for row in rows[1::2]] == [6, 12, 18, 24]
    assert all(row["return_mean"] == 10 - 4 * 0.5 for row in rows[1::2])
    assert all(row["per step"] == pytest.approx(10 / 6) for row in rows[1::2])
    written = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert written[1::2] == rows[1::2]
    assert written[0]["return_mean"] is None  # no episode ended, and JSON knows no nan
    assert np.isnan(rows[0]["return_mean"])


def test_what_is_no_number_stops_it_and_it_goes_on_from_there(tmp_path, monkeypatch):
    monkeypatch.setattr("rp_jax.checkpoints.INTERVAL", 0.0)
    monkeypatch.setattr("rp_jax.checkpoints.SHARE", float("inf"))
    checkpoints = Checkpoints(tmp_path / "checkpoints", say=lambda text: None)
    with pytest.raises(FloatingPointError, match="chunk 3"):
        learn(tmp_path, checkpoints, fails_at=3)
    assert len((tmp_path / "metrics.jsonl").read_text().splitlines()) == 4
    weights, rows, _ = learn(tmp_path, checkpoints)
    assert (weights, len(rows)) == (4, 8)
    assert rows[-1]["steps"] == 24


@pytest.mark.parametrize("name", policy_gradient.LEARNERS)
def test_an_interrupted_policy_gradient_goes_on_to_the_same_bits(name, tmp_path, monkeypatch):
    rollout = ActorCriticConfig("categorical", 8, 16, minibatches=2)
    learning = {"CPO": CPOConfig(rollout), "PID-Lagrangian": PIDConfig(rollout)}[name]
    method = policy_gradient.Method(name, learning, 0.1)
    planning = LoopConfig(steps=8 * 128, num_envs=8, batch=8, replay=64, replay_start=8)
    pmdp, config = probe.make_pmdp(probe, probe.make_params()), tasks.Config(2, planning=planning)

    def learn(folder):
        kept = Checkpoints(folder / "checkpoints", run="one")
        folder.mkdir(exist_ok=True)
        agents = policy_gradient.learn(method, pmdp, config, folder, kept.at("planning"))
        lines = (folder / "metrics.jsonl").read_text().splitlines()
        untimed = [{k: v for k, v in json.loads(x).items() if k != "seconds"} for x in lines]
        return agents.trained.params, untimed

    with stopped_after(3, monkeypatch), pytest.raises(KeyboardInterrupt):
        learn(tmp_path / "apart")
    assert any((tmp_path / "apart" / "checkpoints" / "planning").iterdir())
    apart, at_once = learn(tmp_path / "apart"), learn(tmp_path / "at_once")
    jax.tree.map(np.testing.assert_array_equal, apart[0], at_once[0])
    assert apart[1] == at_once[1]
