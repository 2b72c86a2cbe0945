"""The command that makes all results: what it runs, skips, resumes and reports."""

import dataclasses
import json
import re
import shutil
import signal
import subprocess
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from stubs import picture
from tiny import programs_of_a_moment  # noqa: F401

import rp_jax
from experiments import all as everything
from experiments import report
from experiments.paper import commands, fig6, timing, walls
from experiments.paper import sources as module
from experiments.paper.section import Claim, Section, Table
from rp_jax import storage
from rp_jax.envs import circuit
from rp_jax.envs.tracks import circle_plan
from rp_jax.runs import record
from rp_jax.runs.evaluate import Timing

JAM = "python -m experiments.jam"


class Runs:
    """Stands for processes: writes what they leave, and ends as it is told to."""

    def __init__(self, monkeypatch):
        self.commands, self.exits, self.stops = [], {}, set()
        monkeypatch.setattr(module, "timed", self.timed)

    def timed(self, command, lock):
        assert lock > 2
        self.commands.append(" ".join(command))
        option = "--resume" if "--resume" in command else "--out"
        folder = module.Path(command[command.index(option) + 1])
        folder = folder.parent if folder.suffix else folder
        folder.mkdir(exist_ok=True)
        stops = folder.name in self.stops
        self.stops.discard(folder.name)
        status = 130 if stops else self.exits.get(folder.name, 0)
        if status != 2:  # which is bad input, before anything is written
            facts = {"experiment": " ".join(command[:3]), **record.machine(None)}
            storage.write_json(folder / "config.json", facts)
        checkpoints = folder / record.CHECKPOINTS
        if stops:
            checkpoints.mkdir()
        elif checkpoints.exists():
            checkpoints.rmdir()
        return {"exit": status, "interrupted": stops, "seconds": 2.0, "cpu_seconds": 60.0}


@pytest.fixture
def runs(monkeypatch):
    return Runs(monkeypatch)


def test_a_run_is_made_once_after_the_one_that_it_uses(runs, tmp_path):
    sources = module.Sources(tmp_path, "quick")
    folder = sources("patrol")
    assert sources("patrol") == sources("jam").parent / "patrol" == folder
    first, second = runs.commands
    assert first.startswith("python -m experiments.jam --episodes 1000")
    assert first.endswith(f"--out {tmp_path}/jam")
    assert f"--threat {tmp_path}/jam/threat" in second
    again = module.Sources(tmp_path, "quick")
    again("patrol")
    assert len(runs.commands) == 2
    (entry,) = json.loads((folder / module.LOG).read_text())
    assert entry["command"] == second


def test_an_interrupted_run_stops_everything_and_is_resumed(runs, tmp_path):
    runs.stops.add("jam")
    with pytest.raises(KeyboardInterrupt):
        module.Sources(tmp_path, "quick")("jam")
    module.Sources(tmp_path, "quick")("jam")
    assert runs.commands[1] == f"python -m experiments.jam --resume {tmp_path}/jam"
    assert len(json.loads((tmp_path / "jam" / module.LOG).read_text())) == 2


def test_an_interrupted_run_of_other_code_begins_anew(runs, tmp_path, monkeypatch):
    runs.stops.add("jam")
    with pytest.raises(KeyboardInterrupt):
        module.Sources(tmp_path, "quick")("jam")
    monkeypatch.setattr(record, "code_of", lambda env: {"rp_jax": "other"})
    module.Sources(tmp_path, "quick")("jam")
    assert "--resume" not in runs.commands[1]


def test_a_failed_run_is_not_tried_twice_and_begins_anew_later(runs, tmp_path):
    runs.exits["jam"] = 2
    sources = module.Sources(tmp_path, "quick")
    for name in ("jam", "patrol"):
        with pytest.raises(module.RunError, match=r"experiments\.jam .*: exit status 2$"):
            sources(name)
    assert len(runs.commands) == 1
    (tmp_path / "jam" / "left").touch()
    runs.exits.clear()
    module.Sources(tmp_path, "quick")("jam")
    assert "--resume" not in runs.commands[1]
    assert not (tmp_path / "jam" / "left").exists()


def test_a_run_that_ended_after_its_parent_is_finished(runs, tmp_path):
    (tmp_path / "jam").mkdir()
    storage.write_json(tmp_path / "jam" / "config.json", {"experiment": JAM})
    module.Sources(tmp_path, "quick")("jam")
    assert runs.commands == []


def test_an_interrupted_run_that_was_resumed_by_itself_is_finished(runs, tmp_path):
    runs.stops.add("jam")
    with pytest.raises(KeyboardInterrupt):
        module.Sources(tmp_path, "quick")("jam")
    (tmp_path / "jam" / record.CHECKPOINTS).rmdir()  # as experiments.jam --resume leaves it
    (tmp_path / "jam" / "table.json").touch()
    module.Sources(tmp_path, "quick")("jam")
    assert len(runs.commands) == 1
    assert (tmp_path / "jam" / "table.json").exists()


def test_a_run_that_another_process_makes_is_left_alone(runs, tmp_path):
    sources = module.Sources(tmp_path, "quick")
    (tmp_path / ".locks" / "jam").mkdir(parents=True)
    with storage.locked(tmp_path / ".locks" / "jam", "lock"):
        with pytest.raises(storage.StorageError, match="jam: another process"):
            sources("jam")
        assert runs.commands == []
    assert sources("jam").exists()  # later it can be had


def test_processes_are_timed_and_their_ends_told():
    found = module.timed(["python", "-c", "raise SystemExit(3)"], 0)
    assert (found["exit"], found["interrupted"]) == (3, False)
    assert 0 < found["cpu_seconds"] < 60
    assert found["seconds"] > 0


def stub(results, figures=(), error=None):
    """A result."""

    def run(sources, folder):
        if error:
            raise error
        sources("jam")
        return results

    def plot(results, folder):
        for name in figures:
            picture(folder / name)

    def tell(results):
        claim = Claim("it holds", "<1>", str(results["value"]), "reproduced")
        table = Table("numbers", [{"a|b": results["value"], "c": "<&>"}])
        return Section("words", [table], [claim], dict.fromkeys(figures, "a picture"))

    return types.SimpleNamespace(TITLE="A result", run=run, plot=plot, tell=tell)


def test_one_failure_is_named_and_stops_no_other(runs, tmp_path, monkeypatch, capsys):
    names = {
        "first": stub({"value": 1}, ["one.png", "two.gif"]),
        "second": stub({}, error=OSError("no disk")),
        "third": stub({"value": 3}),
    }
    monkeypatch.setattr(everything, "RESULTS", names)
    out = tmp_path / "paper"
    with pytest.raises(SystemExit, match="1"):
        everything.main(["--out", str(out)])
    shown = capsys.readouterr().out
    assert "failed: second: OSError: no disk" in shown
    assert json.loads((out / "third" / "results.json").read_text()) == {"value": 3}
    text = (out / "REPORT.md").read_text()
    assert "Preset quick" in text
    assert "2 verdicts: 2 reproduced" in text
    assert "second: OSError: no disk" in text
    assert "![a picture](first/one.png)" in text
    assert "| 3 | <&> |" in text
    assert len(runs.commands) == 1
    assert runs.commands[0] in text
    assert "| 1.0 | 0.0 |" in text  # CPU minutes, minutes
    check_page((out / "report.html").read_text(), 2)
    # Later only what is missing is done, the figures again, and all of it is in the report.
    names["second"] = stub({"value": 2})
    names["third"] = stub({}, error=AssertionError("it is done already"))
    (out / "first" / "one.png").unlink()
    assert everything.main(["--resume", str(out)]) == out
    assert (out / "first" / "one.png").exists()
    assert "3 verdicts" in (out / "REPORT.md").read_text()
    assert len(runs.commands) == 1


def test_what_cannot_be_told_is_among_the_failures_and_hides_nothing(runs, tmp_path, monkeypatch):
    names = {name: stub({"value": 1}, ["one.png"]) for name in ("first", "second", "third")}
    monkeypatch.setattr(everything, "RESULTS", names)
    out = tmp_path / "paper"
    everything.main(["--out", str(out)])
    (out / "first" / "one.png").unlink()  # as another process leaves it before it has drawn
    storage.write_json(out / "second" / "results.json", {})  # as earlier code left it
    failed = {}
    shown = str(everything.blocks(out, "quick", failed))
    assert set(failed) == {"first", "second"}
    assert "first: FileNotFoundError" in shown
    assert "second: KeyError: 'value'" in shown
    assert "third/one.png" in shown


def check_page(text, pictures):
    """It holds all of its pictures, and speaks to nobody."""
    assert len(re.findall(r'<img src="data:image/(?:png|gif);base64,[A-Za-z0-9+/=]+"', text)) == (
        pictures
    )
    assert text.count("<img") == pictures
    assert not re.search(r"https?://|<script|<link|@import|url\(", text)
    assert "&lt;&amp;&gt;" in text
    assert '<td class="reproduced">reproduced</td>' in text


def test_ctrl_c_says_how_to_go_on(runs, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(everything, "RESULTS", {"first": stub({"value": 1})})
    runs.stops.add("jam")
    out = tmp_path / "paper"
    with pytest.raises(SystemExit, match="130"):
        everything.main(["--out", str(out)])
    assert f"--resume {out}" in capsys.readouterr().out
    everything.main(["--resume", str(out), "--only", "first"])
    assert (out / "report.html").exists()


def test_a_termination_says_how_to_go_on_and_leaves_the_handler(tmp_path, monkeypatch, capsys):
    def terminated(*_):
        signal.raise_signal(signal.SIGTERM)
        pytest.fail("it went on")

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(module.Sources, "__call__", terminated)
    out = tmp_path / "paper"
    with pytest.raises(SystemExit, match="143"):
        everything.main(["--out", str(out), "--only", "jam"])
    assert f"--resume {out}" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--preset", "huge"], "preset is 'huge'"),
        (["--only", "table9"], "only is 'table9'"),
        (["--resume", "there", "--preset", "full"], "resume is there; only --only may"),
        (["--resume", "there"], "there/config.json: cannot be read"),
    ],
)
def test_bad_input_is_named(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        everything.main(words)
    assert message in capsys.readouterr().out


def test_another_experiments_folder_is_refused(tmp_path):
    storage.write_json(tmp_path / "config.json", {"experiment": JAM})
    with pytest.raises(ValueError, match=r"must be a folder of python -m experiments\.all$"):
        everything.begun(everything.Config(resume=tmp_path))


def test_reports_without_rows_have_no_table(tmp_path):
    report.write(tmp_path, [report.Heading("title", 1), report.Grid("nothing", []), "words"])
    assert (tmp_path / "REPORT.md").read_text().split() == ["#", "title", "words"]
    assert "<table" not in (tmp_path / "report.html").read_text()


def test_each_result_is_listed_and_each_run_used():
    folder = module.Path(everything.__file__).parent / "paper"
    helpers = {"__init__", "commands", "published", "scores", "section", "sources"}
    assert set(everything.RESULTS) == {p.stem for p in folder.glob("*.py")} - helpers
    text = "\n".join(p.read_text() for p in folder.glob("*.py") if p.stem != "commands")
    for name in commands.COMMANDS:
        env = "circuit|jam|point_gather"
        general = re.sub(rf"({env})(?=_|$)", "{env}", name)
        general = re.sub(r"^mpc_.*", "mpc_{env}_{steps}", general)
        general = re.sub(r"^(dqn|cpo|pid)_", "{name}_", general)
        general = re.sub(r"^long_.*", "long_{name}", general)
        assert f'"{name}"' in text or general in text, name


@pytest.fixture
def circuit_runs(finished, tmp_path):
    """What fig6, timing and walls load: the tiny run of Circuit, also as that of DQN."""
    shutil.copytree(finished, tmp_path / "circuit_lost")
    picture(tmp_path / "circuit_lost" / "animation.gif")
    agents = rp_jax.load(finished)
    free = agents.pmdp.replace(threats={}, shielded=False)
    free = dataclasses.replace(agents, pmdp=free, threat=None)
    rp_jax.save(tmp_path / "dqn_circuit" / "dqn", free, {"track": "circle"})
    return lambda name: tmp_path / name


def test_trajectories_of_three_methods(circuit_runs, tmp_path, monkeypatch):
    for name, value in {"TRACKS": ("circle",), "EPISODES": 2, "STEPS_AHEAD": 1}.items():
        monkeypatch.setattr(fig6, name, value)
    folder = tmp_path / "fig6"
    folder.mkdir()
    storage.write_json(folder / "results.json", fig6.run(circuit_runs, folder))
    results = json.loads((folder / "results.json").read_text())
    assert [row["method"] for row in results] == ["RP", "MPC, 1 steps", "DQN, no penalty"]
    for row in results:
        assert len(row["episodes"]) == 2
        for episode in row["episodes"]:
            places, hit = np.asarray(episode["position"]), episode["hit"]
            assert places.shape == (len(hit), 2)
            assert not any(hit[:-1])  # an episode ends with its crash
            assert len(hit) == 201 or hit[-1]
    fig6.plot(results, folder)
    assert set(fig6.tell(results).figures) == {p.name for p in folder.iterdir()} - {"results.json"}


@pytest.mark.slow
def test_all_methods_are_timed_in_one_process(circuit_runs, tmp_path, monkeypatch):
    monkeypatch.setattr(timing, "SEARCHES", {"circuit": (1, 4)})
    monkeypatch.setitem(timing.LEARNED_ON, "circuit", "circle")
    monkeypatch.setattr(timing, "ROUNDS", 1)
    monkeypatch.setattr(timing, "TIMED", {"circuit": {"RP": "circuit_lost"}})
    timed = lambda key, search: Timing(search.horizon, 0.0)  # noqa: E731
    monkeypatch.setattr(timing, "time_search", timed)
    results = timing.run(circuit_runs, tmp_path)
    found = {row["method"]: row["seconds"] for row in results["actions"]}
    assert list(found) == ["RP", "DQN", "CPO", "MPC (1 step)", "MPC (4 steps)"]
    assert found["MPC (4 steps)"] == [4]
    assert all(len(seconds) == 1 and min(seconds) > 0 for seconds in found.values())
    assert {row["variant"] for row in results["actions"]} == {"circle"}
    claims = {claim.claim: claim for claim in timing.tell(results).claims}
    assert claims["Computation time, circuit: MPC (4 steps), 100 actions"].verdict == "exceeded"
    assert not results["learning"][0]["whole"]  # so few labels took no time to speak of
    assert not any("learn the threat" in claim for claim in claims)
    steps, took = (results["learning"][0][k] for k in ("steps", "planning"))
    took += results["learning"][0]["planning_compilation"]
    (planned,) = (claims[claim] for claim in claims if "hours to plan" in claim)
    assert planned.ours.startswith(f"{took / 3600 * 3e6 / steps:.2f} for as many")


def test_walls_jointly_are_never_more_threatening_than_summed():
    params = circuit.make_params(circle_plan(), horizon=2)
    reset = jax.jit(jax.vmap(circuit.reset, (0, None)))
    states = reset(jax.random.split(jax.random.key(0), 8), params)
    fast = states.replace(body=states.body.replace(speed=jnp.full(8, 0.1)))
    points = jax.jit(jax.vmap(circuit.hazards, (0, None)))(fast, params)["wall"]
    sub = circuit.sub_rmdps(params)["wall"]
    near = fast.body.replace(position=points.state[:, 0] + jnp.asarray([0.2, 0.0]))
    joint, summed = walls.exact(jax.random.key(0), near, points, sub)
    assert 0 < joint.max() <= 1
    assert (joint <= summed + 1e-6).all()
    assert (summed > joint + 0.1).any()  # one crash, several points


def test_what_walls_admit_is_a_row_each(circuit_runs, tmp_path, monkeypatch):
    joint = np.zeros((8, 15), np.float32)
    monkeypatch.setattr(walls, "RUNS", {"circuit": "circuit_lost"})
    monkeypatch.setattr(walls, "STATES", 8)
    monkeypatch.setattr(walls, "exact", lambda *_: (joint, joint + 0.5))
    rows = walls.run(circuit_runs, tmp_path)
    assert [row["of"] for row in rows] == ["joint, exact", "sum, exact", "sum, models"]
    assert [row["admissible"] for row in rows[:2]] == [1.0, 1.0]  # x is .9
    assert len(walls.tell(rows).tables[0].rows) == 3


def test_a_part_of_quick_from_the_command_line(tmp_path):
    """Frozen Lake, in processes of its own; then the report again, from what is saved."""
    out = tmp_path / "paper"
    words = [sys.executable, "-m", "experiments.all", "--only", "fig2", "fig3"]
    done = subprocess.run([*words, "--out", str(out)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    text = (out / "report.html").read_text()
    assert text.count("<img") == 3
    assert "only RIGHT is safe" in text
    assert 'class="not"' in text  # eta 0 earns something
    shutil.rmtree(out / "runs")
    (out / "report.html").unlink()
    assert everything.main(["--resume", str(out), "--only", "fig3"]) == out
    again = (out / "report.html").read_text()
    assert again[: again.index("What was run")] == text[: text.index("What was run")]
