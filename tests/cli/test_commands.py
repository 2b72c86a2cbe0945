"""The commands of rp-jax on finished runs, and how runs are read back."""

import dataclasses
import json
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy import stats
from tiny import programs_of_a_moment  # noqa: F401

from experiments import circuit, jam
from rp_jax import statistics, storage
from rp_jax.cli import certify_command, main, rare_command
from rp_jax.cli.choice import Choice, chosen
from rp_jax.runs import dataclass_json, rare_events, saved
from rp_jax.runs.evaluate import evaluate
from rp_jax.runs.rare_events import RareConfig


def call(*words):
    main.main([str(word) for word in words])


@pytest.mark.parametrize("module", [circuit, jam])
@pytest.mark.parametrize("recipe", ["tuned", "paper"])
def test_settings_come_back_as_they_were_written(module, recipe, tmp_path):
    config = dataclasses.replace(module.full(recipe), x=float("inf"))
    storage.write_json(tmp_path / "config.json", config)
    plain = json.loads((tmp_path / "config.json").read_text())
    assert dataclass_json.restored(module.Config, plain, "file") == config


@pytest.mark.parametrize(
    ("field", "value", "kind"),
    [
        ("seeds", 1.5, "int"),
        ("seeds", True, "int"),
        ("x", "big", "float"),
        ("shield", 1, "bool"),
        ("test_obstacles", 3, "tuple"),
        ("test_obstacles", ["3"], "int"),
    ],
)
def test_settings_of_the_wrong_type_are_named(field, value, kind):
    with pytest.raises(storage.StorageError, match=rf"file: {field} is .*{kind}"):
        dataclass_json.restored(jam.Config, {field: value}, "file")
    with pytest.raises(storage.StorageError, match="must be a table"):
        dataclass_json.restored(jam.Config, {"planning": 3}, "file")


def test_a_setting_that_has_no_default_is_missed():
    with pytest.raises(storage.StorageError, match=r"^file: c is missing; it must be there"):
        dataclass_json.restored(certify_command.CertifyOptions, {"run": "a"}, "file")


def test_a_run_comes_back_with_the_agents_that_its_table_speaks_of(finished):
    found = chosen(Choice(run=finished))
    assert (found.name, found.variant, len(found.agents)) == ("circuit", "circle", 2)
    table = json.loads((finished / "table.json").read_text())
    again = evaluate(jax.random.key(0), found.agents, episodes=16, penalty=200.0)
    for row, kept in zip(again, table, strict=True):
        assert row["crashes"] == kept["crashes"]
        assert row["return_mean"] == pytest.approx(kept["return_mean"], rel=1e-5)
    with pytest.raises(ValueError, match="variant is 'N=8'; it must be one of 'circle'"):
        chosen(Choice(run=finished, variant="N=8"))


def test_a_run_is_evaluated_in_another_world_by_the_command(finished, tmp_path, capsys):
    call(
        *("evaluate", "--run", finished, "--set", "track=narrowed", "time_limit=5"),
        *("--episodes", "8", "--out", tmp_path / "table"),
    )
    (first, second) = json.loads((tmp_path / "table" / "table.json").read_text())
    assert first["variant"] == "circle track=narrowed time_limit=5"
    assert first["steps"] <= 40
    assert (first["seed"], second["seed"]) == (0, 1)
    assert "crash rate" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--set", "track"], "set is 'track'; it must be KEY=VALUE"),
        (["--set", "tracks=oval"], "it must fit make_params"),
        (["--set", "track=oval"], "track is 'oval'; it must be one of"),
        (["--set", "baseline=plans"], "hazards are ['wall']; they must be []"),
        (["--env", "no_such_world"], "env is 'no_such_world', which cannot be imported"),
        (["--episodes", "0"], "episodes is 0; it must be an integer, at least 1"),
    ],
)
def test_a_world_that_does_not_fit_is_named(words, says, finished, capsys):
    with pytest.raises(SystemExit, match="2"):
        call("evaluate", "--run", finished, *words)
    assert says in " ".join(capsys.readouterr().out.split())


def test_the_checksum_speaks_of_agents_and_threats(finished, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(finished, copy)
    sha256 = chosen(Choice(run=finished)).sha256
    assert chosen(Choice(run=copy)).sha256 == sha256
    agents = saved.load(copy)
    other = jax.tree.map(lambda a: a + 1, agents.weights)
    saved.save_agents(copy, dataclasses.replace(agents, weights=other), {})
    assert chosen(Choice(run=copy)).sha256 != sha256


@pytest.mark.parametrize("missing", ["agent/manifest.json", "threat/manifest.json"])
def test_a_run_with_something_missing_is_refused(missing, finished, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(finished, copy)
    (copy / missing).unlink()
    with pytest.raises(ValueError, match=missing.split("/")[-1]):
        chosen(Choice(run=copy))


def test_a_rate_is_shown_or_not_shown_with_the_planned_episodes(finished, tmp_path, capsys):
    out = tmp_path / "row.json"
    common = ["certify", "--run", finished, "--out", out]
    with pytest.raises(SystemExit, match="0"):  # in a single step from rest nothing is hit
        call(*common, "--c", "0.2", "--confidence", "0.9", "--set", "time_limit=1")
    row = json.loads(out.read_text())
    assert row["shown"]
    assert row["crashes"] <= row["allowed_crashes"]
    assert row["episodes"] == row["planned_episodes"]
    assert row["upper_bound"] <= 0.2
    assert "SHOWN: circuit circle time_limit=1" in " ".join(capsys.readouterr().out.split())
    out.unlink()
    with pytest.raises(SystemExit, match="1"):
        call(*common, "--c", "0.2", "--expected", "0")  # it has hardly learned
    row = json.loads(out.read_text())
    assert not row["shown"]
    assert row["crashes"] > row["allowed_crashes"]
    assert row["upper_bound"] is None
    assert "NOT SHOWN" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--c", "0"], "c is 0.0"),
        (["--c", "0.1", "--confidence", "1"], "confidence is 1.0"),
        (["--c", "0.1", "--expected", "0.2"], "expected is 0.2"),
        (["--c", "0.1", "--expected", "0.0999999"], "c is 0.1 and expected is 0.0999999"),
        (["--c", "0.1", "--agent", "2"], "agent is 2; it must be"),
        (["--c", "0.1", "--variant", "N=8"], "variant is 'N=8'"),
    ],
)
def test_what_cannot_be_certified_is_named(words, message, finished, capsys):
    with pytest.raises(SystemExit, match="2"):
        call("certify", "--run", finished, *words)
    assert message in " ".join(capsys.readouterr().out.split())


SIZES = RareConfig(particles=20, repeats=3, generations=2, population=20, tries=4, kept=3, checks=8)


@pytest.mark.slow
def test_rare_events_and_worst_starts_of_a_run(drawn, tmp_path):
    found, out = chosen(Choice(run=drawn)), storage.new_folder(tmp_path / "rare")
    config = rare_command.RareOptions(run=drawn, out=out, sizes=SIZES)
    row = rare_command.run(config, found, out)
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
    starts = rare_events.load_starts(out / "worst_starts", found.agents.pmdp, found.about)
    offset = starts.obstacles.position - starts.body.position[:, None]
    assert (np.linalg.norm(offset, axis=-1) >= jam.jam.CLEARANCE).all()
    again = storage.new_folder(tmp_path / "again")
    only = dataclasses.replace(config, out=again, starts=out / "worst_starts")
    second = rare_command.run(only, found, again)
    assert second["worst_starts"] == row["worst_starts"]  # the same agent, starts and keys
    assert "estimate" not in second
    assert [path.name for path in again.iterdir()] == ["rare.json"]


KEPT = Path(__file__).parents[2] / "docs" / "results"


@pytest.mark.slow
def test_the_agent_that_comes_with_the_project_still_survives_its_worst_starts(tmp_path):
    """Dynamics, threats and shield may change, but not for the worse: recorded starts, anew."""
    recorded = json.loads((KEPT / "rare" / "rare.json").read_text())
    before = np.asarray([[s["crashes"], s["episodes"]] for s in recorded["worst_starts"]])
    folder = storage.new_folder(tmp_path / "again")
    config = rare_command.RareOptions(
        run=KEPT / "jam_ahead",
        out=folder,
        variant=recorded["variant"],
        starts=KEPT / "rare" / "worst_starts",
        sizes=RareConfig(checks=40),
        seed=recorded["seed"] + 1,
    )
    found = chosen(config)
    assert found.sha256 == recorded["sha256"]
    now = rare_command.run(config, found, folder)["worst_starts"]
    crashes, episodes = sum(s["crashes"] for s in now), sum(s["episodes"] for s in now)
    assert episodes == 40 * len(before)
    k, n = before.sum(axis=0)
    assert crashes <= stats.binom.ppf(0.9999, episodes, statistics.upper_bound(k, n))
