"""--resume: what it refuses, and a run that goes on where it was stopped."""

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import probe
import pytest
from tiny import programs_of_a_moment  # noqa: F401

import rp_jax
from rp_jax import FitConfig, ThreatConfig, checkpoints, evaluation, storage
from rp_jax.cli import errors, experiment
from rp_jax.runs import train
from rp_jax.runs.train import Process
from rp_jax.threat import artefact

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


def test_the_library_alone_is_compared_where_the_world_is_not_known(begun):
    path = begun / "config.json"
    facts = json.loads(path.read_text())
    facts["code"]["my_room.world"], facts["versions"]["brax"] = "0123", "0.1"
    storage.write_json(path, facts)
    argv = ["--resume", str(begun)]
    assert experiment.interrupted(begun, "killed", None, argv) == facts
    with pytest.raises(ValueError, match=r"its versions: brax is 0\.1"):
        experiment.interrupted(begun, "killed", probe, argv)
    facts["versions"]["jax"] = "0.1"
    storage.write_json(path, facts)
    with pytest.raises(ValueError, match=r"its versions: jax is 0\.1"):
        experiment.interrupted(begun, "killed", None, argv)


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
        with pytest.raises(SystemExit, match="143"), again:
            signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGINT, usual)
    assert "terminated (between two steps); to go on: killed" in " ".join(
        capsys.readouterr().out.split()
    )
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_run_of_another_world_is_refused(begun, capsys):
    path = begun / "config.json"
    plain = json.loads(path.read_text())
    plain["world"]["tests"]["slip 0.1"] = {"slip": 0.2}
    storage.write_json(path, plain)
    refused(capsys, "its tests: slip 0.1 is {'slip': 0.2}", "--resume", begun)


def test_ctrl_c_ends_a_run_with_another_code(begun, capsys):
    again = errors.resumable("killed", begun, lambda: pytest.fail("it was not finished"))
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs ignore it
    try:
        with pytest.raises(SystemExit, match="130"), again:
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, usual)
    said = " ".join(capsys.readouterr().out.split())
    assert "interrupted (between two steps); to go on: killed" in said


def test_a_termination_finishes_the_step_and_keeps_a_checkpoint(begun, capsys):
    loop = checkpoints.Checkpoints(begun / "loop", name="counting", say=lambda text: None)

    def step(i, state):
        if i == 2:
            signal.raise_signal(signal.SIGTERM)
        return state + 1

    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    again = errors.resumable("killed", begun, lambda: pytest.fail("it was not finished"))
    with pytest.raises(SystemExit, match="143"), again:
        loop.loop(np.asarray(0), step, 5)
    said = " ".join(capsys.readouterr().out.split())
    assert "terminated (counting: 3 of 5 done); to go on: killed" in said
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
    made = []
    assert loop.loop(np.asarray(0), lambda i, state: made.append(i) or state + 1, 5) == 5
    assert made == [3, 4]


def test_only_a_command_line_handles_termination(tmp_path):
    """Neither imports nor calls of the library do."""
    before = signal.getsignal(signal.SIGTERM)
    seen = []

    def step(i, state):
        seen.append(signal.getsignal(signal.SIGTERM))
        return state

    checkpoints.Checkpoints(tmp_path / "loop").loop(np.asarray(0), step, 2)
    assert seen == [before, before]


@pytest.mark.slow
def test_a_run_that_is_terminated_ends_with_143_and_goes_on(tmp_path):
    """As Slurm and Kubernetes do it, to a process of its own."""
    out, code = (
        tmp_path / "run",
        (
            "import sys; sys.path[:0] = sys.argv[1:3]; import jax, forked; from quick import "
            "unoptimised; from rp_jax.cli import experiment\n"
            "with unoptimised(), jax.numpy_rank_promotion('allow'):\n"
            "    experiment.run(forked.corridor(), sys.argv[3:])"
        ),
    )
    tests = Path(__file__).parents[1]
    command = [sys.executable, "-u", "-c", code, str(tests), str(tests / "runs")]
    first = [*command, "--no-figures", "--planning.steps", "2000000", "--out", str(out)]
    with subprocess.Popen(first, stdout=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 120
        while not (out / "metrics.jsonl").exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        process.send_signal(signal.SIGTERM)
        said = " ".join(process.communicate(timeout=120)[0].split())
    assert process.returncode == 143
    assert "of 30 done); to go on: killed --resume" in said
    assert list((out / "checkpoints" / "plan").glob("[0-9]*"))
    again = subprocess.Popen([*command, "--resume", str(out)], stdout=subprocess.PIPE, text=True)
    with again as process:
        for line in process.stdout:
            if "plan: " in line and "were done" in line:
                break
        else:
            pytest.fail("it began anew")
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=120)


def corridor_threat(folder):
    """The threat function of the corridor, as a run makes it."""
    fit = FitConfig(hidden=(8,), steps=40, batch=32)
    config = ThreatConfig(states=1000, miss_rate=1.0, test_states=100, fit=fit)
    key, params = jax.random.key(0), probe.make_params()
    return rp_jax.reconnoitre(key, probe, params, x=0.5, config=config, folder=folder)


def test_a_run_is_resumed_from_elsewhere_with_its_own_copy_of_the_threats(
    tmp_path, monkeypatch, capsys
):
    """The folder was given by a path that means nothing there, and holds another one by now."""
    home, other = tmp_path / "home", tmp_path / "other"
    home.mkdir()
    other.mkdir()
    corridor_threat(home / "threats")
    checksum = artefact.saved_checksum(home / "threats")
    used = []

    def job(run, bar):
        if run.process.threat == Path("threats"):  # before anything was made
            raise KeyboardInterrupt
        used.append(train.threat_of(None, *run[:3], run.folder, run.process, bar).checksum)

    mine = forked.corridor()._replace(job=job)
    monkeypatch.chdir(home)
    with pytest.raises(SystemExit, match="130"):
        experiment.run(mine, ["--no-figures", "--threat", "threats", "--out", "run"])
    shutil.rmtree(home / "threats")
    monkeypatch.chdir(other)
    assert experiment.run(mine, ["--resume", "../home/run"]) == Path("../home/run")
    assert used == [checksum]
    assert json.loads((home / "run" / "config.json").read_text())["process"]["threat"] == "threats"
