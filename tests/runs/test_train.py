import csv
import json
import re
import subprocess
import sys

import jax
import numpy as np
import pytest
from tiny import MODULES, go, programs_of_a_moment  # noqa: F401

from experiments import circuit, point_gather
from rp_jax import storage
from rp_jax.runs import saved, train
from rp_jax.runs.progress import silent
from rp_jax.runs.train import Process
from rp_jax.streams import Stream, key_of, numbered
from rp_jax.threat import artefact

PROMISED = [
    *("env", "variant", "method", "seed", "episodes", "return_mean", "return_ci95"),
    *("uncrashed_return_mean", "crashes", "crash_rate", "crash_upper95", "threat"),
    *("danger_mean", "goal_rate", "interventions", "insecure"),
    *("promised", "booked_mean", "booked_ci95", "seconds_per_100_actions", "train_seconds"),
]


def read(path):
    return json.loads(path.read_text(), parse_constant=lambda name: pytest.fail(name))


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def names(folder):
    """Files, without the checksum in their names."""
    paths = [p.relative_to(folder) for p in folder.rglob("*") if p.is_file()]
    return {re.sub(r"arrays-\w+", "arrays", str(path)) for path in paths}


FILES = {
    *("config.json", "metrics.jsonl", "table.json", "table.csv", "summary.json", "training.json"),
    *("agent/arrays.bin", "agent/manifest.json", "threat/arrays.bin", "threat/manifest.json"),
    *("threat/report.json", "threat/curves.json"),
}


def test_a_run_leaves_all_its_files_and_no_others(finished):
    assert names(finished) == FILES


def check_table(folder, variants, seeds):
    rows = read(folder / "table.json")
    assert [(row["variant"], row["seed"]) for row in rows] == [
        (variant, seed) for variant in variants for seed in seeds
    ]
    for row in rows:
        assert set(PROMISED) - {"promised", "booked_mean", "booked_ci95"} <= set(row)
        assert row["episodes"] == 16
        assert row["crash_rate"] == row["crashes"] / 16 <= row["crash_upper95"]
        assert 0 <= row["interventions"] <= 1
        assert row["seconds_per_100_actions"] > 0
        assert row["train_seconds"] > 0
        assert sum(row["collisions"].values()) >= row["crashes"]
    with (folder / "table.csv").open() as file:
        table = list(csv.DictReader(file))
    assert list(table[0]) == PROMISED
    for shown, row in zip(table, rows, strict=True):
        for name in ("variant", "method"):
            assert shown[name] == row[name]
        for name in ("seed", "episodes", "return_mean", "crashes", "crash_upper95"):
            assert float(shown[name]) == row[name]
    return rows


def test_the_table_has_a_row_per_variant_and_seed(finished):
    rows = check_table(finished, ["circle"], [0, 1])
    assert {row["method"] for row in rows} == {"RP (x=0.9)"}
    assert {row["env"] for row in rows} == {"circuit"}


def check_training(folder, warm, envs):
    training, history = read(folder / "training.json"), lines(folder / "metrics.jsonl")
    assert training["inadmissible"] == 0
    assert sum(row["inadmissible"] for row in history) == 0
    assert training["crashes"] == sum(row["crashes"] for row in history)
    assert training["episodes"] == sum(row["episodes"] for row in history)
    for seed in (0, 1):
        steps = [row["steps"] for row in history if row["seed"] == seed]
        assert steps == sorted(set(steps))
        assert steps[-1] * 2 == training["steps"]
        assert steps[-1] >= 480
    assert all(np.isfinite(row["loss"]) for row in history)
    assert set(training["seconds"]) >= {"reconnaissance", "planning", "planning_compilation"}


def test_training_is_accounted_for(finished):
    check_training(finished, 64, 8)


def test_the_settings_are_kept(finished):
    config = read(finished / "config.json")
    assert (config["world"]["name"], config["preset"]) == ("circuit", "quick")
    assert config["world"]["env"] == "rp_jax.envs.circuit"
    assert config["world"]["settings"]["track"] == "circle"
    settings = config["config"]
    assert (settings["x"], settings["seeds"], settings["track"]) == (0.9, 2, "circle")
    assert settings["planning"]["num_envs"] == 8
    assert settings["wall"] == config["threats"]["wall"]
    assert settings["wall"]["fit"]["hidden"] == [16]
    assert not config["process"]["figures"]
    assert set(config["versions"]) >= {"rp_jax", "jax", "flax", "optax"}


def check_agents(folder, name):
    agents = saved.load(folder)
    assert [member.seed for member in agents.members] == [0, 1]
    for leaf in jax.tree.leaves(agents.weights):
        assert np.isfinite(leaf).all()
    kernels = [leaf for leaf in jax.tree.leaves(agents.weights) if leaf.ndim == 3]
    assert all((kernel[0] != kernel[1]).any() for kernel in kernels)  # the seeds differ


def test_the_agents_of_all_seeds_are_saved(finished):
    check_agents(finished, "circuit")


def test_the_threat_function_has_its_report(finished):
    rows = read(finished / "threat" / "report.json")
    assert [(row["hazard"], row["of"]) for row in rows] == [("wall", "one"), ("wall", "sum")]
    about = storage.read_manifest(finished / "threat", artefact.KIND)["about"]
    assert (about["environment"], about["x"]) == ("rp_jax.envs.circuit", 0.9)
    assert about["networks"]["wall"]["hidden"] == [16]
    curves = read(finished / "threat" / "curves.json")
    assert curves["wall"][-1]["step"] == 40


def test_the_threats_of_a_seed_share_no_key_with_anything_else(monkeypatch, tmp_path):
    """Neither with those of another seed, nor with planning or evaluation."""
    keys, world = [], circuit.make_world(circuit.Config())
    monkeypatch.setattr(train, "reconnoitre", lambda key, *_, **__: keys.append(key))
    for seed in range(20):
        config = circuit.Config(seed=seed)
        train.threat_of(jax.random.key(0), world, config, {}, tmp_path, Process(), silent)
    root = jax.random.key(0)
    others = [key_of(root, stream) for stream in Stream]
    others += [key for stream in Stream for key in numbered(key_of(root, stream), list(range(20)))]
    mine = [key_of(key, stream) for key in keys for stream in (Stream.THREAT, Stream.SUMS)]
    words = [tuple(np.asarray(jax.random.key_data(key)).tolist()) for key in [*mine, *others]]
    assert len(set(words)) == len(words)


def test_a_saved_threat_function_serves_another_track_and_threshold(finished, tmp_path):
    config = circuit.Config(track="narrowed", x=0.1)
    world, process = circuit.make_world(config), Process(threat=finished / "threat")
    key = jax.random.key(0)
    found = train.threat_of(key, world, config, {}, tmp_path, process, silent)
    subs = world.env.sub_rmdps(world.params())
    for folder in (finished, tmp_path):  # the new run's folder is whole without the other's
        kept = storage.leaves(artefact.load(folder / "threat", subs)[0])
        for name, array in storage.leaves(found.models).items():
            np.testing.assert_array_equal(array, kept[name])
    about = [artefact.about(folder / "threat") for folder in (finished, tmp_path)]
    assert about[0] == about[1]


@pytest.mark.slow
def test_a_run_of_jam_leaves_figures_and_an_animation(drawn):
    figures = {
        *("learning_curves.png", "threat_fit.png", "trajectories.png", "threat_of_all.png"),
        *("threat_of_one_obstacle.png", "threat_of_one_wall_point.png"),
    }
    assert names(drawn) == FILES | {f"figures/{name}" for name in figures} | {"animation.gif"}
    for name in figures:
        assert (drawn / "figures" / name).read_bytes().startswith(b"\x89PNG")
    assert (drawn / "animation.gif").read_bytes().startswith(b"GIF8")
    check_table(drawn, ["N=3"], [0, 1])
    check_training(drawn, 64, 8)
    check_agents(drawn, "jam")
    rows = read(drawn / "threat" / "report.json")
    assert [row["hazard"] for row in rows] == ["obstacle", "wall"] * 2


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["tuned", "paper"])
def test_a_run_of_point_gather_leaves_figures_and_an_animation(recipe, tmp_path):
    folder = go("point_gather", tmp_path / recipe, f"--recipe {recipe} --test-bombs 8 --horizon 3")
    names = ("learning_curves", "threat_fit", "trajectories", "threat_of_all", "threat_of_one_bomb")
    for name in names:
        assert (folder / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "animation.gif").read_bytes().startswith(b"GIF8")
    check_table(folder, ["8 bombs"], [0, 1])
    check_training(folder, 64, 8)


def test_point_gather_needs_a_test():
    with pytest.raises(ValueError, match=r"^test_bombs is \(\)"):
        point_gather.make_world(point_gather.Config(test_bombs=()))


@pytest.mark.slow
def test_its_threat_function_serves_other_thresholds_and_counts(drawn, tmp_path):
    again = f"--no-figures --threat {drawn / 'threat'} --x 0.5 --obstacles 2 --test-obstacles 1 4"
    folder = go("jam", tmp_path / "again", again)
    assert names(folder) == FILES - {"threat/report.json", "threat/curves.json"}
    rows = check_table(folder, ["N=1", "N=4"], [0, 1])
    assert {row["method"] for row in rows} == {"RP (x=0.5)"}
    assert read(folder / "training.json")["inadmissible"] == 0
    assert read(folder / "config.json")["process"]["threat"] == str(drawn / "threat")


@pytest.mark.slow
def test_a_run_without_a_shield_trains_and_evaluates(tmp_path):
    options = "--no-figures --no-shield --learning-penalty 200 --track circle --test-tracks circle"
    folder = go("circuit", tmp_path / "dqn", options)
    assert names(folder) == {name for name in FILES if not name.startswith("threat/")}
    rows = check_table(folder, ["circle"], [0, 1])
    assert {row["method"] for row in rows} == {"DQN (penalty 200)"}
    assert all(row["interventions"] == row["insecure"] == 0 for row in rows)
    assert not read(folder / "config.json")["config"]["shield"]


def test_a_task_can_be_run_as_a_module(tmp_path):
    command = [sys.executable, "-m", "experiments.jam", "--x", "nan", "--out", str(tmp_path / "o")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "x is nan" in done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "o").exists()
