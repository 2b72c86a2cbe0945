"""Options of commands: each is heard, or refused."""

import dataclasses
import inspect
import json
from pathlib import Path

import jax
import pytest
from tiny import programs_of_a_moment  # noqa: F401

from rp_jax.cli import frontier_command, main, shields, train_command
from rp_jax.cli.choice import AgentChoice, Choice, chosen
from rp_jax.cli.evaluate_command import EvaluateOptions
from rp_jax.cli.experiment import Run
from rp_jax.envs import circuit, jam
from rp_jax.runs import ablation, frontier, train
from rp_jax.runs.train import Process, TrainConfig, World

WHOLE = TrainConfig(
    x=0.3,
    lookahead=2,
    learning_penalty=3.0,
    learning_penalty_from=1.0,
    insecure_penalty=4.0,
    penalty=5.0,
    episodes=7,
    seeds=2,
    seed=11,
)
KEY = jax.random.key(0)
PASSED = ("lookahead", "learning_penalty", "learning_penalty_from", "insecure_penalty", "penalty")


def exits(code, *words):
    with pytest.raises(SystemExit) as stop:
        main.main([str(word) for word in words])
    assert stop.value.code == code


def said(capsys):
    out = capsys.readouterr()
    return " ".join((out.out + out.err).split())


def test_settings_of_a_run_without_tests_stay_where_others_are_set(finished, tmp_path):
    """As `rp-jax train` writes it without --test."""
    for file in finished.rglob("*"):
        if file.is_file():
            copy = tmp_path / file.relative_to(finished)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(file.read_bytes())
    facts = json.loads((tmp_path / "config.json").read_text())
    own = {**facts["world"]["settings"], "time_limit": 33}
    facts["world"] |= {"settings": own, "tests": {"": own}}
    (tmp_path / "config.json").write_text(json.dumps(facts))
    with pytest.raises(ValueError, match=r"source/radius is 0\.1"):  # the threats hold for .1
        chosen(Choice(run=tmp_path, set=("radius=0.12",)))
    for given, limit in ((("fidelity=paper",), 33), (("time_limit=5",), 5)):
        found = chosen(Choice(run=tmp_path, set=given)).agents.pmdp.params
        assert int(found.time_limit) == limit
    found = chosen(Choice(run=tmp_path, set=("hide_position=0.5",))).agents.pmdp.params
    assert (int(found.time_limit), float(found.hide_position)) == (33, 0.5)


def test_set_may_be_given_more_than_once():
    words = ["--env", "rp_jax.envs.jam", "--set", "num_obstacles=3", "--set", "time_limit=9"]
    world, rest = train_command.world_from([*words, "--test", "a:time_limit=5", "--seeds", "2"])
    assert world.settings == {"num_obstacles": 3, "time_limit": 9}
    assert world.tests == {"a": {"num_obstacles": 3, "time_limit": 5}}
    assert rest == ["--seeds", "2"]


def test_one_agent_is_named_only_where_one_is_meant(finished, capsys):
    assert "agent" not in EvaluateOptions.__dataclass_fields__
    exits(2, "evaluate", "--run", finished, "--agent", "1")
    assert "--agent" in said(capsys)
    with pytest.raises(
        ValueError, match="agent is 2; it must be an integer, at least 0, at most 1"
    ):
        chosen(AgentChoice(run=finished, agent=2))


def test_a_statement_replaces_no_other(finished, tmp_path, capsys):
    (tmp_path / "row.json").write_text("{}")
    exits(2, "certify", "--run", finished, "--c", "0.5", "--out", tmp_path / "row.json")
    assert "row.json; it must be a new file, but this exists" in said(capsys)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["evaluate", "--run", "nowhere"], "folder is nowhere; there is no such folder"),
        (
            ["certify", "--run", "RUN", "--c", "2"],
            "c is 2.0; it must be a number above 0 and below 1",
        ),
        (
            ["certify", "--run", "RUN", "--c", "1e-9"],
            "more episodes; it must take 2,000,000,000 at",
        ),
        (["certify", "--run", "RUN", "--c", ".1", "--env", "experiments"], "has no `reset`"),
        (["evaluate", "--run", "RUN", "--env", "rp_jax.envs.jam"], "do not fit rp_jax.envs.jam"),
        (["check", "--env", "no_such_world"], "env is 'no_such_world', which cannot be imported"),
        (
            ["check", "--env", "rp_jax.envs.jam", "--seed", "-1"],
            "seed is -1; it must be an integer",
        ),
        (
            ["check", "--env", "rp_jax.envs.jam", "--sets", "1"],
            "--sets is no option of rp-jax check",
        ),
        (
            ["frontier", "--env", "rp_jax.envs.circuit", "--thresholds", ".1", ".01"],
            "thresholds is (0.1, 0.01); it must ascend",
        ),
        (["frontier", "--env", "rp_jax.envs.circuit", "--x", "inf"], "x is inf; it must be"),
        (
            ["frontier", "--env", "rp_jax.envs.circuit", "--no-shield"],
            "shield is False; it must be one of True",
        ),
        (
            ["train", "--env", "rp_jax.envs.circuit", "--test", "fat:radius=0.15"],
            "test fat: wall: source/radius is 0.15",
        ),
        (
            ["train", "--env", "rp_jax.envs.circuit", "--no-shield", "--threat", "RUN/threat"],
            "without a shield it must not be given",
        ),
    ],
    ids=lambda value: " ".join(value[:4]) if isinstance(value, list) else "",
)
def test_bad_options_are_named_and_nothing_is_begun(
    words, says, finished, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    exits(2, *[word.replace("RUN", str(finished)) for word in words])
    assert says in said(capsys)
    assert list(tmp_path.iterdir()) == []


def test_a_test_that_is_seen_otherwise_is_found_before_learning():
    class Room:
        """Its observation has a number for each obstacle."""

        def __getattr__(self, name):
            return getattr(jam, name)

        def observe(self, state, params):
            return state.obstacles.position.reshape(-1)

    room = Room()
    room.LIDAR_BINS, room.SCALE = 0, ()
    tests = {"N=3": {"num_obstacles": 3}, "N=4": {"num_obstacles": 4}}
    world = World("room", room, {"num_obstacles": 3}, tests)
    says = r"test N=4: length of the observation is 8; it must be 6, as where the agents learned"
    with pytest.raises(ValueError, match=says):
        train.checked(world, TrainConfig(), {}, Process())


class Stop(Exception):  # noqa: N818
    """No more is needed."""


def told(monkeypatch, module, name):
    """The keywords that a function of a module is called with; nothing more is done."""
    calls = []

    def listen(*args, **given):
        calls.append(given)
        raise Stop

    monkeypatch.setattr(module, name, listen)
    return calls


def a_run(config):
    return Run(World("circuit", circuit, {}, {"": {}}), config, {}, Process(), Path("nowhere"))


def test_a_frontier_is_learned_with_all_settings(monkeypatch):
    kind = dataclasses.make_dataclass(
        "Config", [("thresholds", tuple, (0.1, 0.2))], bases=(TrainConfig,), frozen=True
    )
    config = kind(**{f.name: getattr(WHOLE, f.name) for f in dataclasses.fields(WHOLE)})
    monkeypatch.setattr(frontier_command, "threat_of", lambda *_: None)
    with monkeypatch.context() as patch:
        calls = told(patch, frontier, "frontier")
        with pytest.raises(Stop):
            frontier_command.job(a_run(config), lambda *_: None)
    settings = {name: getattr(WHOLE, name) for name in PASSED}
    assert {name: calls[0][name] for name in PASSED} == settings
    assert calls[0]["seeds"] == [11, 12]
    planned = told(monkeypatch, frontier, "plan")
    with pytest.raises(Stop):
        frontier.frontier(KEY, None, None, None, thresholds=(0.1, 0.2), tests={}, **settings)
    assert {name: planned[0][name] for name in PASSED} == settings


def test_a_comparison_of_shields_is_made_with_all_settings(monkeypatch):
    known = set(inspect.signature(ablation.compare_shields).parameters)
    config = TrainConfig(x=0.3, lookahead=2, insecure_penalty=4.0, penalty=5.0, seeds=2, seed=11)
    monkeypatch.setattr(shields, "threat_of", lambda *_: None)
    calls = told(monkeypatch, shields.ablation, "compare_shields")
    with pytest.raises(Stop):
        shields.job(a_run(config), lambda *_: None)
    (given,) = calls
    assert (given["lookahead"], given["insecure_penalty"], given["seeds"]) == (2, 4.0, [11, 12])
    assert set(given) <= known
