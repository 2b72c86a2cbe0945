"""All methods side by side, as small as they get."""

import dataclasses
import json
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from tiny import programs_of_a_moment  # noqa: F401

from experiments import compare
from rp_jax import storage
from rp_jax.baselines.actor_critic import ActorCriticConfig
from rp_jax.baselines.cpo import CPOConfig
from rp_jax.baselines.pid_lagrangian import PIDConfig
from rp_jax.cli import experiment
from rp_jax.envs import circuit
from rp_jax.runs import policy_gradient, record
from rp_jax.threat import artefact
from rp_jax.threat.model import ThreatModel, ThreatNetwork

SMALL = {"num-envs": 8, "length": 16, "epochs": 1, "minibatches": 2}


@pytest.mark.slow
def test_every_method_has_its_rows(finished, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(compare.SETTINGS, "circuit", ((0.0, 20.0), 1e-3, 1))
    out = tmp_path / "compare"
    words = "--env circuit --steps 6000 --episodes 8 --mpc-episodes 2"
    for method in ("cpo", "pid"):
        for name, value in SMALL.items():
            words += f" --{method}.rollout.{name} {value}"
    files = ["--threat", str(finished / "threat"), "--out", str(out)]
    compare.main(compare.COMMAND, [*words.split(), *files])
    rows = json.loads((out / "compare.json").read_text())
    methods = list(dict.fromkeys(row["method"] for row in rows))
    assert methods == [
        *("RP (x=0.001)", "DQN (penalty 0)", "DQN (penalty 20)"),
        *("CPO", "PID-Lagrangian", "MPC (1 step)"),
    ]
    for method in methods:
        mine = [row for row in rows if row["method"] == method]
        assert len(mine) == 3  # tracks
        for row in mine:
            assert row["episodes"] == (2 if "MPC" in method else 8)
            assert row["crash_ci95"][0] <= row["crash_rate"] <= row["crash_ci95"][1]
            assert row["seconds_per_100_actions"] > 0
            assert (row["training_steps"] >= 6000) == ("MPC" not in method)
            assert row["training_crashes"] <= row["training_episodes"]
            assert row["side_by_side"] == {"DQN": 2, "MPC": 0}.get(method[:3], 1)
    for name, method in {"cpo": "CPO", "pid": "PID-Lagrangian"}.items():
        text = (out / name / "metrics.jsonl").read_text()
        history = [json.loads(line) for line in text.splitlines()]
        dqn = json.loads((out / "dqn" / "metrics.jsonl").read_text().splitlines()[0])
        kept = storage.read_manifest(out / name / "agent", policy_gradient.KIND)["about"]
        assert (kept["method"], len(kept["members"])) == (method, 1)
        own = {"cpo": {"kl", "recoveries", "accepted"}, "pid": {"multiplier"}}[name]
        assert set(history[0]) == set(dqn) - {"insecure", "inadmissible", "loss"} | own
        if name == "cpo":
            assert all(0 <= line[k] <= 1 for line in history for k in own)
            assert any(line["accepted"] > 0 for line in history)
        steps = [line["steps"] for line in history]
        assert steps == sorted(set(steps))
        (mine,) = {
            tuple(r[f"training_{k}"] for k in ("steps", "episodes", "crashes"))
            for r in rows
            if r["method"] == method
        }
        assert mine == (steps[-1], *(sum(h[k] for h in history) for k in ("episodes", "crashes")))
    shown = capsys.readouterr().out
    for variant in {row["variant"] for row in rows}:
        assert f"circuit {variant}" in shown


def test_an_interrupted_comparison_goes_on_with_the_methods_that_are_left(tmp_path, monkeypatch):
    made, left = [], []

    def maker(method, stops):
        def make(config, run, folder, bar):
            made.append(method)
            if stops and not left:
                left.append(method)
                raise KeyboardInterrupt
            assert folder == run.folder / method.lower()
            return [{"env": "jam", "variant": "N=3", "method": method, "x": float("inf")}]

        return make

    makers = {method: maker(method, method == "PID") for method in compare.METHODS}
    monkeypatch.setattr(compare, "MAKERS", makers)
    monkeypatch.setattr(compare, "show", lambda rows: None)
    out = tmp_path / "new"
    words = ["--env", "jam", "--methods", "MPC", "PID", "CPO", "--steps", "6000"]
    with pytest.raises(SystemExit, match="130"):
        compare.main(compare.COMMAND, [*words, "--out", str(out)])
    assert made == ["CPO", "PID"]
    compare.main(compare.COMMAND, ["--resume", str(out)])
    assert made == ["CPO", "PID", "PID", "MPC"]
    rows = json.loads((out / "compare.json").read_text())
    assert [row["method"] for row in rows] == ["CPO", "PID", "MPC"]
    assert rows[0]["x"] == "inf"
    assert not (out / record.CHECKPOINTS).exists()


def test_settings_come_back_from_the_file(tmp_path, monkeypatch):
    config = compare.Config("jam", methods=("PID",), steps=6000, out=tmp_path)
    facts = {"experiment": compare.COMMAND.name, **dataclasses.asdict(config)}
    experiment.begin(tmp_path, {**facts, **record.machine(compare)})
    went_on = []
    command = compare.COMMAND._replace(job=lambda *of: went_on.append(of))
    compare.main(command, ["--resume", str(tmp_path)])
    ((found, run, folder),) = went_on
    assert found == config
    assert run.config == compare.settings_of(config)
    assert run.world.name == "jam"
    assert folder == tmp_path


def test_it_is_resumed_from_elsewhere_with_its_own_copy_of_the_threats(tmp_path, monkeypatch):
    home, other = tmp_path / "home", tmp_path / "other"
    home.mkdir()
    other.mkdir()
    subs = circuit.sub_rmdps(circuit.make_params())
    network = ThreatNetwork((4,), 15)
    weights = network.init(jax.random.key(0), jnp.zeros(3))
    wall = ThreatModel(subs["wall"].source, weights, jnp.ones(3), jnp.zeros(()), network)
    artefact.save(home / "threats", "rp_jax.envs.circuit", {"wall": wall}, subs, {})
    went_on = []

    def job(config, run, folder):
        went_on.append(run.process.threat)
        if len(went_on) == 1:
            raise KeyboardInterrupt

    command = compare.COMMAND._replace(job=job)
    monkeypatch.chdir(home)
    words = ["--env", "circuit", "--steps", "6000", "--threat", "threats", "--out", "run"]
    with pytest.raises(SystemExit, match="130"):
        compare.main(command, words)
    shutil.rmtree("threats")
    monkeypatch.chdir(other)
    compare.main(command, ["--resume", "../home/run"])
    assert went_on == [Path("threats"), Path("../home/run/threat")]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"env": "maze"}, "env"),
        ({"methods": ("SAC",)}, "methods"),
        ({"methods": ()}, "methods"),
        ({"steps": 10}, "steps"),
        ({"episodes": 0}, "episodes"),
        ({"mpc_episodes": 0}, "mpc_episodes"),
        ({"seeds": 0}, "seeds"),
        ({"cpo": CPOConfig(divergence=0)}, "cpo.divergence"),
        ({"pid": PIDConfig(rollout=ActorCriticConfig(minibatches=7))}, "pid.rollout.minibatches"),
    ],
)
def test_bad_settings_are_named(change, field):
    config = dataclasses.replace(compare.Config("jam"), **change)
    with pytest.raises(ValueError, match=f"^{field} is "):
        compare.settings_of(config)
