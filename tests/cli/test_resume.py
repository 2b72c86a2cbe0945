"""--resume: what it refuses, and a run that goes on where it was stopped."""

import json
import signal
import sys
from pathlib import Path

import jax
import pytest
from tiny import programs_of_a_moment  # noqa: F401

from rp_jax import checkpoints, evaluation, storage
from rp_jax.cli import errors, experiment
from rp_jax.runs import train
from rp_jax.runs.train import Process

sys.path.append(str(Path(__file__).parents[1] / "runs"))
import forked


def call(*argv, name="killed"):
    return experiment.run(forked.corridor(name), [str(word) for word in argv])


@pytest.fixture
def begun(tmp_path):
    """A run that was stopped at its very beginning."""
    corridor = forked.corridor()
    folder = tmp_path / "run"
    folder.mkdir()
    config = corridor.presets["quick"]("tuned")
    world, threats = corridor.make_world(config), experiment.threats_of(config)
    facts = train.facts(world, config, threats, Process(figures=False))
    experiment.begin(folder, {"experiment": "killed", "preset": "quick", **facts})
    return folder


def refused(capsys, says, *argv, **more):
    with pytest.raises(SystemExit) as stop:
        call(*argv, **more)
    assert stop.value.code == 2
    assert says in " ".join(capsys.readouterr().out.split())


def test_no_other_option_goes_with_it(begun, capsys):
    says = "no other option may be given with it"
    refused(capsys, says, "--resume", begun, "--seeds", "2")
    refused(capsys, says, "--x", "0.1", "--resume", begun)
    refused(capsys, says, "--preset", "quick", f"--resume={begun}")


def test_what_is_no_interrupted_run_is_refused(begun, capsys, tmp_path):
    refused(capsys, "config.json: cannot be read", "--resume", tmp_path / "nowhere")
    (begun / "checkpoints").rmdir()
    refused(capsys, "there are no checkpoints: it is finished", "--resume", f"{begun}/./")
    refused(capsys, "there are no checkpoints: it is finished", f"--resume={begun}/")
    refused(capsys, "there are no checkpoints: it is finished", "--resume", begun)


@pytest.mark.parametrize(
    "change",
    [
        {"versions": {"jax": "0.1"}},
        {"device": "TPU_0"},
        {"code": "0123"},
        {"flags": {"XLA_FLAGS": "--xla_cpu_enable_fast_math=true"}},
    ],
)
def test_a_run_begun_elsewhere_is_refused(change, begun, capsys):
    path = begun / "config.json"
    storage.write_json(path, {**json.loads(path.read_text()), **change})
    refused(capsys, f"its {next(iter(change))}", "--resume", begun)


def test_a_disk_that_is_full_when_figures_are_drawn_is_told(begun, capsys):
    again = errors.resumable("python -m killed", begun, lambda: None)
    with pytest.raises(SystemExit, match="1"), again:
        raise OSError(28, "No space left on device")
    said = " ".join(capsys.readouterr().out.split())
    assert "error: [Errno 28] No space left on device; to go on: python -m killed" in said


def test_a_run_of_another_experiment_is_refused(begun, capsys):
    refused(capsys, "its experiment is killed; it must be other", "--resume", begun, name="other")


@pytest.mark.slow
def test_a_run_stopped_by_nan_goes_on_to_the_same_bits(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    monkeypatch.setattr(checkpoints, "SHARE", float("inf"))
    with jax.numpy_rank_promotion("allow"):
        alone = call("--no-figures", "--out", tmp_path / "alone")
        folder = tmp_path / "run"
        check = evaluation.check

        def fails(rows, name):
            if name == "evaluation slip 0.3":
                raise FloatingPointError("slip 0.3: threats of 7 steps are nan or infinite")
            check(rows, name)

        with monkeypatch.context() as patch:
            patch.setattr(evaluation, "check", fails)
            with pytest.raises(SystemExit) as stop:
                call("--no-figures", "--out", folder)
        assert stop.value.code == 1
        said = " ".join(capsys.readouterr().out.split())
        assert "error: slip 0.3: threats of 7 steps" in said
        assert f"to go on: killed --resume {folder}" in said
        assert (folder / "checkpoints" / "evaluation slip 0.3").exists()
        assert call("--resume", folder) == folder
    assert forked.outcome(folder) == forked.outcome(alone)
    assert not (folder / "checkpoints").exists()


@pytest.mark.parametrize("ctrl_c", [signal.default_int_handler, signal.SIG_IGN])
def test_a_termination_ends_a_run_as_an_interruption(ctrl_c, begun, capsys):
    """Also where Ctrl-C is ignored: shells start background jobs so."""
    before, usual = signal.getsignal(signal.SIGTERM), signal.signal(signal.SIGINT, ctrl_c)
    again = errors.resumable("killed", begun, lambda: pytest.fail("it was not finished"))
    try:
        with pytest.raises(SystemExit, match="130"), again:
            signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGINT, usual)
    assert "to go on: killed" in " ".join(capsys.readouterr().out.split())
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_run_of_another_world_is_refused(begun, capsys):
    path = begun / "config.json"
    plain = json.loads(path.read_text())
    plain["world"]["tests"]["slip 0.1"] = {"slip": 0.2}
    storage.write_json(path, plain)
    refused(capsys, "its tests: slip 0.1 is {'slip': 0.2}", "--resume", begun)
