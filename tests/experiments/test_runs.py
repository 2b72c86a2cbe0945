"""What is done with finished runs: reading them back, certificates, rare events."""

import dataclasses
import json
import shutil
import sys
import types
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy import stats
from tiny import programs_of_a_moment  # noqa: F401

from experiments import certify, circuit, jam, mpc, rare, runs, settings, tasks
from rp_jax import evaluate, statistics, storage
from rp_jax.envs.tracks import circle_plan
from rp_jax.planning import loop


@pytest.mark.parametrize("module", [circuit, jam])
@pytest.mark.parametrize("recipe", ["tuned", "paper"])
def test_settings_come_back_as_they_were_written(module, recipe, tmp_path):
    config = dataclasses.replace(module.full(recipe), x=float("inf"), threat=Path("a/b"))
    storage.write_json(tmp_path / "config.json", dataclasses.asdict(config))
    plain = json.loads((tmp_path / "config.json").read_text())
    assert settings.restored(module.Config, plain, "file") == config


@pytest.mark.parametrize(
    ("field", "value", "kind"),
    [
        ("seeds", 1.5, "int"),
        ("seeds", True, "int"),
        ("x", "big", "float"),
        ("figures", 1, "bool"),
        ("out", 3, "Path"),
        ("test_obstacles", 3, "tuple"),
        ("test_obstacles", ["3"], "int"),
    ],
)
def test_settings_of_the_wrong_type_are_named(field, value, kind):
    with pytest.raises(storage.StorageError, match=rf"file: {field} is .*{kind}"):
        settings.restored(jam.Config, {field: value}, "file")
    with pytest.raises(storage.StorageError, match="must be a table"):
        settings.restored(jam.Config, {"planning": 3}, "file")


def test_a_setting_that_has_no_default_is_missed():
    with pytest.raises(storage.StorageError, match=r"^file: env is missing; it must be there"):
        settings.restored(mpc.Config, {"horizon": 3}, "file")


def test_only_runs_of_the_pipeline_have_agents_to_load(finished, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(finished, copy)
    plain = json.loads((copy / "config.json").read_text())
    storage.write_json(copy / "config.json", {**plain, "experiment": "experiments.patrol"})
    says = r"experiment is 'experiments.patrol'; it must be one of 'experiments.circuit'"
    with pytest.raises(ValueError, match=says):
        runs.load(copy)


def test_a_run_comes_back_with_the_agents_that_its_table_speaks_of(finished):
    run = runs.load(finished)
    assert run.task.name == "circuit"
    assert run.config.seeds == 2
    pmdp = run.pmdp("circle")
    network = loop.make_network(run.config.planning, pmdp)
    table = json.loads((finished / "table.json").read_text())

    def one(key, params):
        return evaluate.run_episodes(
            key, pmdp, evaluate.action_values(network, params), 16, batch=16
        )

    keys = jax.numpy.stack([tasks.key_of(i, tasks.EVALUATION) for i in range(2)])
    rows = jax.jit(jax.vmap(one))(keys, run.params)
    for i in range(2):
        found = evaluate.summarise(jax.tree.map(lambda a, i=i: a[i], rows), 200.0)
        assert found["crashes"] == table[i]["crashes"]
        assert found["return_mean"] == pytest.approx(table[i]["return_mean"], rel=1e-5)
    with pytest.raises(ValueError, match="variant is 'N=8'; it must be one of 'circle'"):
        run.pmdp("N=8")


def test_the_hash_speaks_of_settings_agents_and_threats(finished, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(finished, copy)
    assert runs.load(copy).sha256 == runs.load(finished).sha256
    plain = json.loads((copy / "config.json").read_text())
    storage.write_json(copy / "config.json", {**plain, "out": None, "threat": "elsewhere"})
    assert runs.load(copy).sha256 == runs.load(finished).sha256
    storage.write_json(copy / "config.json", {**plain, "x": 0.8})
    assert runs.load(copy).sha256 != runs.load(finished).sha256


@pytest.mark.parametrize("missing", ["config.json", "agent/manifest.json", "threat/manifest.json"])
def test_a_run_with_something_missing_is_refused(missing, finished, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(finished, copy)
    (copy / missing).unlink()
    with pytest.raises(ValueError, match=missing.split("/")[-1]):
        runs.load(copy)


def test_a_rate_is_shown_or_not_shown_with_the_planned_episodes(finished, monkeypatch, tmp_path):
    config = certify.Config(run=finished, c=0.999, confidence=0.9, expected=0.9)
    row = certify.run(config)
    n, allowed = row["planned_episodes"], row["allowed_crashes"]
    assert row["shown"] == (row["crashes"] <= allowed)
    assert row["shown"]  # nothing crashes for certain
    assert row["episodes"] == n
    assert row["upper_bound"] <= 0.999
    assert "SHOWN: circuit circle" in certify.statement(row)
    out = tmp_path / "row.json"
    words = ["certify", "--run", str(finished), "--c", "0.2", "--expected", "0", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit, match="1"):
        certify.main()  # an agent that has hardly learned, with a threat model to match
    row = json.loads(out.read_text())
    assert not row["shown"]
    assert row["crashes"] > row["allowed_crashes"]
    assert row["upper_bound"] is None
    assert certify.statement(row).startswith("NOT SHOWN")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--c", "0"], "c is 0.0"),
        (["--c", "0.1", "--confidence", "1"], "confidence is 1.0"),
        (["--c", "0.1", "--expected", "0.2"], "expected is 0.2"),
        (["--c", "0.1", "--expected", "0.0999999"], "expected: episodes needed is"),
        (["--c", "0.1", "--agent", "2"], "agent is 2; it must be"),
        (["--c", "0.1", "--variant", "N=8"], "variant is 'N=8'"),
    ],
)
def test_what_cannot_be_certified_is_named(words, message, finished, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["certify", "--run", str(finished), *words])
    with pytest.raises(SystemExit, match="2"):
        certify.main()
    assert message in capsys.readouterr().out


def test_rare_events_and_worst_starts_of_a_run(drawn, tmp_path):
    loaded = runs.load(drawn)
    out = storage.new_folder(tmp_path / "rare")
    sizes = {"particles": 20, "repeats": 3, "generations": 2, "population": 20, "tries": 4}
    config = rare.Config(run=drawn, out=out, kept=3, checks=8, **sizes)
    row = rare.run(config, loaded, out)
    assert json.loads((out / "rare.json").read_text())["estimate"] == pytest.approx(row["estimate"])
    if row["estimate"] > 0:
        assert row["ci95"][0] <= row["estimate"] <= row["ci95"][1]
    else:
        assert row["ci95"] is None
    assert row["plain"]["steps"] >= row["steps"]
    assert len(row["worst_starts"]) == 3
    for start in row["worst_starts"]:
        assert start["episodes"] == 8
        assert 0 <= start["crashes"] <= 8
    pmdp = loaded.pmdp("N=3")
    like = jax.vmap(jam.jam.reset, (0, None))(jax.random.split(jax.random.key(0), 3), pmdp.params)
    starts = storage.load(out / "worst_starts", "start states", like)
    offset = starts.obstacles.position - starts.agent.position[:, None]
    assert (np.linalg.norm(offset, axis=-1) >= jam.jam.CLEARANCE).all()
    again = storage.new_folder(tmp_path / "again")
    only = dataclasses.replace(config, out=again, starts=out / "worst_starts")
    second = rare.run(only, loaded, again)
    assert second["worst_starts"] == row["worst_starts"]  # the same agent, starts and keys
    assert "estimate" not in second
    assert [path.name for path in again.iterdir()] == ["rare.json"]


def test_worst_starts_of_another_task_or_in_no_number_are_refused(drawn, tmp_path):
    pmdp = runs.load(drawn).pmdp("N=3")
    about = {"env": "jam", "variant": "N=3"}
    one = jax.tree.map(lambda a: a[None], jam.jam.reset(jax.random.key(0), pmdp.params))
    storage.save(tmp_path / "set", rare.STARTS, one, about | {"count": 1})
    jax.tree.map(
        np.testing.assert_array_equal, rare.known_starts(tmp_path / "set", pmdp, about), one
    )
    with pytest.raises(ValueError, match="variant is 'N=3'; it must be one of 'N=8'"):
        rare.known_starts(tmp_path / "set", pmdp, about | {"variant": "N=8"})
    for count in (0, 1.5, None, 2):
        storage.save(tmp_path / "set", rare.STARTS, one, about | {"count": count})
        with pytest.raises(ValueError, match=r"set.*it must be"):
            rare.known_starts(tmp_path / "set", pmdp, about)


KEPT = Path(__file__).parents[2] / "docs" / "results"


@pytest.mark.slow
def test_the_agent_that_comes_with_the_project_still_survives_its_worst_starts(tmp_path):
    """Dynamics, threats and shield may change, but not for the worse: recorded starts, anew."""
    recorded = json.loads((KEPT / "rare" / "rare.json").read_text())
    before = np.asarray([[s["crashes"], s["episodes"]] for s in recorded["worst_starts"]])
    folder = storage.new_folder(tmp_path / "again")
    config = rare.Config(
        run=KEPT / "jam_ahead",
        out=folder,
        variant=recorded["variant"],
        starts=KEPT / "rare" / "worst_starts",
        checks=40,
        seed=recorded["seed"] + 1,
    )
    loaded = runs.load(config.run)
    assert loaded.sha256 == recorded["sha256"]
    now = rare.run(config, loaded, folder)["worst_starts"]
    crashes, episodes = sum(s["crashes"] for s in now), sum(s["episodes"] for s in now)
    assert episodes == 40 * len(before)
    k, n = before.sum(axis=0)
    assert crashes <= stats.binom.ppf(0.9999, episodes, statistics.upper_bound(k, n))


def test_the_search_for_worst_starts_descends_from_many_and_keeps_none_twice():
    params = jam.jam.make_params(3)
    keys = jax.random.split(jax.random.key(0), 6)
    starts = jax.vmap(jam.jam.reset, (0, None))(keys, params)
    often = np.asarray([4, 0, 4, 1, 1, 5])
    once = rare.distinct(jax.tree.map(lambda a: a[often], starts))
    first = jax.tree.map(lambda a: a[np.asarray([4, 0, 1, 5])], starts)
    jax.tree.map(np.testing.assert_array_equal, once, first)

    played = []

    def stage(key, paths, pmdp, level):
        played.append(paths.states)
        return paths._replace(crashed=paths.states.agent.position[:, 0] > 0)

    pmdp = types.SimpleNamespace(env=jam.jam, params=params, x=np.float32(0))
    subject = rare.Subject(pmdp, None, stage)
    sizes = {"generations": 2, "population": 10, "tries": 1, "kept": 3}
    config = rare.Config(run=Path(), out=Path(), **sizes)
    known = jax.tree.map(lambda a: jax.numpy.repeat(a[:2], 50, axis=0), starts)
    found = rare.worst_starts(jax.random.key(1), subject, known, config)
    assert found.time.shape == (3,)
    assert rare.distinct(found).time.shape == (3,)
    begun = np.asarray(played[0].obstacles.position)
    for start in np.asarray(starts.obstacles.position[:2]):  # both, and fresh ones beside them
        assert (begun == start).all(axis=(1, 2)).sum() == 1
    assert len(begun) == 10


def test_offspring_differ_from_their_parent_in_some_obstacles():
    params = jam.jam.make_params(8)
    parent = jam.jam.reset(jax.random.key(0), params)
    fresh = jam.jam.reset(jax.random.key(1), params)
    child = rare.offspring(jax.random.key(2), parent, fresh, 0.5)
    same = np.asarray((child.obstacles.position == parent.obstacles.position).all(-1))
    other = np.asarray((child.obstacles.position == fresh.obstacles.position).all(-1))
    assert (same ^ other).all()
    assert same.any()
    assert other.any()
    alone = circuit.circuit.make_params(circle_plan())
    first, second = (circuit.circuit.reset(jax.random.key(i), alone) for i in (0, 1))
    for share, wanted in ((0.0, first), (1.0, second)):
        jax.tree.map(
            np.testing.assert_array_equal,
            rare.offspring(jax.random.key(3), first, second, share),
            wanted,
        )
