import dataclasses
import importlib.util
import json
import os

import jax
import jax.numpy as jnp
import pytest

from experiments import circuit, jam, point_gather
from rp_jax import storage
from rp_jax.cli import errors, experiment
from rp_jax.runs import train
from rp_jax.runs.train import Process
from rp_jax.threat import artefact
from rp_jax.threat.model import ThreatModel, ThreatNetwork

MODULES = {"circuit": circuit, "jam": jam, "point_gather": point_gather}
as_root = hasattr(os, "geteuid") and os.geteuid() == 0


def call(name, *argv):
    return experiment.run(MODULES[name].EXPERIMENT, argv)


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """Calls that must end with code 2 and a message, with nothing run or written."""

    def forbidden(*args, **kwargs):
        pytest.fail("work was begun on bad input")

    monkeypatch.chdir(tmp_path)
    for name in ("train", "reconnoitre", "plan", "evaluate"):
        monkeypatch.setattr(train, name, forbidden)

    def check(name, *argv, says, keeps=()):
        capsys.readouterr()
        with pytest.raises(SystemExit) as stop:
            call(name, *map(str, argv))
        assert stop.value.code == 2
        said = capsys.readouterr()
        words = " ".join((said.out + said.err).split())
        for part in [says] if isinstance(says, str) else says:
            assert part in words
        assert "Traceback" not in words
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted(keeps)

    return check


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["--preset", "huge"], "preset is 'huge'; it must be one of 'quick', 'full'"),
        (["--recipe", "best"], "recipe is 'best'; it must be one of 'tuned', 'paper'"),
        (["--preset=[/red]"], "preset is '[/red]'; it must be"),
        (["--seeds", "0"], "seeds is 0; it must be an integer, at least 1"),
        (["--episodes", "-10"], "episodes is -10; it must be"),
        (["--devices", "two"], "devices is 'two'; it must be one of 'one', 'all', 'cluster'"),
        (["--x", "nan"], "x is nan; it must be a number, at least 0"),
        (["--x", "-0.1"], "x is -0.1; it must be a number, at least 0"),
        (["--penalty", "inf"], "penalty is inf; it must be a finite number"),
        (["--fidelity", "text"], "fidelity is 'text'; it must be one of 'released', 'paper'"),
        (["--planning.network", "deep"], "planning.network is 'deep'; it must be one of"),
        (["--planning.steps", "100"], "planning.steps is 100; it must be an integer, at least 256"),
        (["--planning.batch", "-8"], "planning.batch is -8; it must be"),
        (["--planning.replay", "10"], "planning.replay is 10; it must be an integer, at least"),
        (["--planning.learner.gamma", "1.5"], "planning.learner.gamma is 1.5; it must be"),
        (["--wall.states", "-5"], "wall.states is -5; it must be an integer, at least 100"),
        (["--wall.sampling", "lazy"], "wall.sampling is 'lazy'; it must be one of"),
        (["--wall.miss-rate", "0"], "wall.miss_rate is 0.0; it must be"),
        (["--wall.fit.hidden", "0"], "wall.fit.hidden is 0; it must be"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_value_out_of_range_is_named_with_what_is_allowed(argv, says, refused):
    refused("circuit", *argv, says=("error:", says))


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["--episodes", "many"], "--episodes"),
        (["--episodes", "1.5"], "--episodes"),
        (["--episode", "7"], "--episode"),
        (["--no-such-thing"], "--no-such-thing"),
        (["--wall.fit.cosine", "perhaps"], "perhaps"),
        (["stray"], "stray"),
        (["--preset"], "--preset"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_cannot_be_parsed_is_named(argv, says, refused):
    refused("jam", *argv, says=says)


def test_unknown_tracks_are_named(refused):
    says = "is 'oval'; it must be one of 'default', 'narrowed', 'circle'"
    refused("circuit", "--track", "oval", says=f"track {says}")
    refused("circuit", "--test-tracks", "circle", "oval", says=f"test_tracks {says}")
    refused("circuit", "--test-tracks", says="test_tracks is (); it must name at least one")


def test_values_of_jam_out_of_range_are_named(refused):
    refused("jam", "--obstacles", "0", says="obstacles is 0; it must be an integer, at least 1")
    refused("jam", "--obstacles", "-8", says="obstacles is -8; it must be")
    refused("jam", "--obstacles", "100000", says=("obstacles is 100000; it must be", "at most 225"))
    refused(
        "jam",
        "--test-obstacles",
        "3",
        "226",
        says="test N=226: num_obstacles is 226; it must be",
    )
    refused("jam", "--test-obstacles", says="test_obstacles is (); it must name at least one")
    refused("jam", "--x", "nan", says="x is nan; it must be a number, at least 0")
    refused("jam", "--preset", "huge", says="preset is 'huge'; it must be one of 'quick', 'full'")
    refused("jam", "--obstacle.paths", "1", says="obstacle.paths is 1; it must be")


def test_folders_that_cannot_be_had_are_named(refused, tmp_path):
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "table.csv").write_text("results")
    (tmp_path / "file").touch()
    keeps = ["old", "file"]
    refused("jam", "--out", "old", says="out is old; it must be a new or an empty", keeps=keeps)
    refused("jam", "--out", "file", says="out is file; it must be a new or an empty", keeps=keeps)
    refused("jam", "--out", "file/new", says="out is file/new; it cannot be created", keeps=keeps)
    refused("jam", "--out", "n" * 300, says="; it cannot be created", keeps=keeps)
    assert (tmp_path / "old" / "table.csv").read_text() == "results"


@pytest.mark.skipif(as_root, reason="root may write anywhere")
def test_folders_without_permission_are_named(refused, tmp_path):
    (tmp_path / "locked").mkdir(0o500)
    refused("jam", "--out", "locked", says="out is locked; it cannot be written", keeps=["locked"])
    refused("jam", "--out", "locked/new", says="it cannot be created", keeps=["locked"])


def save_threat(folder, name, **changes):
    """Untrained models of an environment."""
    module = MODULES[name]
    env = module.make_world(module.quick("tuned")).env
    subs = env.sub_rmdps(env.make_params(**changes))
    models = {}
    for kind, sub in subs.items():
        width = {"wall": 3, "obstacle": 6}[kind]
        network = ThreatNetwork((4,), 15)
        weights = network.init(jax.random.key(0), jnp.zeros(width))
        models[kind] = ThreatModel(sub.source, weights, jnp.ones(width), jnp.zeros(()), network)
    artefact.save(folder, name, models, subs, {})


def test_threats_that_do_not_fit_are_named(refused, tmp_path):
    save_threat(tmp_path / "circuit", "circuit")
    save_threat(tmp_path / "wide", "jam", radius=0.15)
    keeps = ["circuit", "wide"]
    says = "hazards are ['wall']; they must be ['obstacle', 'wall']"
    refused("jam", "--threat", "circuit", says=says, keeps=keeps)
    says = "source/radius is 0.15"
    refused("jam", "--threat", "wide", says=says, keeps=keeps)
    says = "nowhere: there is no manifest.json"
    refused("jam", "--threat", "nowhere", says=says, keeps=keeps)
    says = "hazards are ['obstacle', 'wall']"
    refused("circuit", "--threat", "wide", says=says, keeps=keeps)
    says = "threat is wide; without a shield it must not be given"
    refused("jam", "--no-shield", "--threat", "wide", says=says, keeps=keeps)


def test_damaged_threats_are_named(refused, tmp_path):
    save_threat(tmp_path / "good", "circuit")
    (arrays,) = (tmp_path / "good").glob("arrays-*.bin")
    manifest = tmp_path / "good" / "manifest.json"
    data = arrays.read_bytes()
    arrays.write_bytes(data[:500] + bytes([data[500] ^ 1]) + data[501:])
    says = ".bin: the checksum differs"
    refused("circuit", "--threat", "good", says=says, keeps=["good"])
    arrays.write_bytes(data[:-1])
    refused("circuit", "--threat", "good", says="the manifest says", keeps=["good"])
    arrays.write_bytes(data)
    facts = json.loads(manifest.read_text())
    facts["about"]["networks"]["wall"]["hidden"] = [10**9]
    manifest.write_text(json.dumps({**facts, "seal": storage.manifest_checksum(facts)}))
    refused("circuit", "--threat", "good", says="hidden is [1000000000]", keeps=["good"])
    manifest.write_text("{")
    refused("circuit", "--threat", "good", says="manifest.json: cannot be read", keeps=["good"])


@pytest.fixture
def no_matplotlib(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "matplotlib" else find(name)
    )


def test_figures_without_matplotlib_are_refused_after_all_else(refused, no_matplotlib):
    refused("jam", "--figures", says="figures is True; without matplotlib it must be False")
    refused("jam", "--figures", "--x", "nan", says="x is nan")


def test_without_matplotlib_figures_are_off(no_matplotlib, capsys):
    assert not Process().figures
    errors.without_figures(Process().figures)
    assert "no figures: matplotlib is not installed" in capsys.readouterr().out
    errors.without_figures(True)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("name", MODULES)
def test_help_lists_presets_recipes_and_settings(name, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        call(name, "--help")
    assert stop.value.code == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    steps = "--bomb.fit.steps" if name == "point_gather" else "--wall.fit.steps"
    for part in ("--preset", "quick", "full", "--recipe", "tuned", "paper", steps):
        assert part in text
    assert f"python -m experiments.{name}" in text
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def prepared(tmp_path, monkeypatch):
    """What a run would be made with."""
    calls = []
    monkeypatch.chdir(tmp_path)

    def job(experiment):
        return lambda run, bar: calls.append(run)

    monkeypatch.setattr(experiment, "_whole", job)

    def settings(name, *argv):
        folder = call(name, *argv)
        run = calls.pop()
        config = run.config
        assert run.folder == folder
        assert not (folder / "checkpoints").exists()  # the run is over
        return config, json.loads((folder / "config.json").read_text())["preset"], folder

    return settings


def test_good_input_reaches_the_run_in_a_new_folder(prepared, tmp_path):
    config, preset, folder = prepared(
        "jam", "--x", "inf", "--seeds", "3", "--test-obstacles", "1", "225", "--out", "a/b"
    )
    assert preset == "quick"
    assert (config.seeds, config.test_obstacles) == (3, (1, 225))
    assert config.x == float("inf")
    assert (tmp_path / folder).is_dir()


def test_results_go_to_a_folder_of_their_own_by_default(prepared, tmp_path):
    _, _, folder = prepared("circuit", "--preset", "full")
    assert folder.parent.name == "results"
    assert folder.name.startswith("circuit-full-")
    assert (tmp_path / folder).is_dir()


def test_presets_and_recipes_set_what_can_be_overridden(prepared):
    quick, _, _ = prepared("jam", "--out", "1")
    full, _, _ = prepared("jam", "--preset", "full", "--out", "2")
    paper, _, _ = prepared("jam", "--recipe", "paper", "--seeds", "2", "--out", "3")
    assert full.seeds > quick.seeds
    assert full.episodes > quick.episodes
    assert paper.planning.network == "paper"
    assert paper.obstacle.fit.hidden == (500, 500, 500)
    assert paper.seeds == 2
    ours, _, _ = prepared("jam", "--wall.fit.hidden", "5", "6", "--no-figures", "--out", "4")
    assert ours.wall.fit.hidden == (5, 6)
    kept = dataclasses.replace(ours.wall.fit, hidden=quick.wall.fit.hidden)
    assert kept == quick.wall.fit  # all else is the preset's
    for config in (quick, full, paper):
        config.validate()


def test_an_interruption_ends_with_its_own_code(tmp_path, monkeypatch, capsys):
    def interrupted(*args, **more):
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train, "train", interrupted)
    with pytest.raises(SystemExit) as stop:
        call("jam", "--out", "here")
    assert stop.value.code == 130
    assert "here" in capsys.readouterr().out
