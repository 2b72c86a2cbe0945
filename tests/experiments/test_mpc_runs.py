"""The command that measures MPC."""

import json

import jax.numpy as jnp
import pytest
from quick import compile_soon, stopped_after  # noqa: F401

from experiments import mpc
from rp_jax.runs import tree_search


def command(*words):
    mpc.main(mpc.COMMAND, words)


def test_the_command_writes_a_table(tmp_path, capsys):
    out = tmp_path / "run"
    words = ["--env", "jam", "--horizon", "1", "--episodes", "3", "--variants", "N=3"]
    command(*words, "--out", str(out))
    assert {path.name for path in out.iterdir()} == {"config.json", "table.csv", "table.json"}
    (row,) = json.loads((out / "table.json").read_text())
    assert (row["variant"], row["method"], row["episodes"]) == ("N=3", "MPC (1 step)", 3)
    assert row["seconds_per_100_actions_in_batch"] > 0
    assert row["cpu_seconds_per_100_actions"] > 0
    penalties = json.loads((out / "config.json").read_text())["penalties"]
    assert penalties == {"table": 50, "search": 50}
    assert "CPU seconds one after another" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        command(*words, "--out", str(out))  # the folder exists


def test_an_interrupted_search_goes_on_to_the_same_table(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tree_search, "GROUP", 2)
    words = ["--env", "jam", "--horizon", "1", "--episodes", "6", "--variants", "N=3"]
    command(*words, "--out", str(tmp_path / "at_once"))
    folder = tmp_path / "run"
    with stopped_after(2, monkeypatch), pytest.raises(SystemExit, match="130"):
        command(*words, "--out", str(folder))
    assert f"--resume {folder}" in capsys.readouterr().out
    command("--resume", str(folder))
    assert "N=3: 2 of 3 were done" in capsys.readouterr().out
    tables = [
        json.loads((out / "table.json").read_text()) for out in (folder, tmp_path / "at_once")
    ]
    (one,), (other,) = (
        [{k: v for k, v in r.items() if "second" not in k} for r in t] for t in tables
    )
    assert one == other
    assert not (folder / "checkpoints").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--env", "maze", "--horizon", "2"), "env is 'maze'; it must be one of 'circuit', 'jam'"),
        (("--env", "jam", "--horizon", "0"), "horizon is 0; it must be an integer, at least 1"),
        (("--env", "jam", "--horizon", "2", "--episodes", "0"), "episodes is 0; it must be"),
        (("--env", "jam", "--horizon", "2", "--variants", "N=4"), "variants is 'N=4'; it must be"),
        (("--env", "jam", "--horizon", "2", "--penalty", "-1"), "penalty is -1.0; it must be"),
        (("--env", "jam", "--horizon", "2", "--limit", "nan"), "limit is nan; it must be"),
    ],
)
def test_bad_input_is_named(capsys, tmp_path, words, message):
    with pytest.raises(SystemExit, match="2"):
        command(*words, "--out", str(tmp_path / "run"))
    assert message in capsys.readouterr().out
    assert not (tmp_path / "run").exists()


def test_penalties_are_those_of_the_paper():
    for env, penalty in (("circuit", 200), ("jam", 50)):
        ready = mpc.prepared(mpc.Config(env=env, horizon=2))
        assert ready.penalties == {"table": penalty, "search": penalty}
        assert len(ready.searches) == 3
        assert all(float(search.penalty) == penalty for search in ready.searches.values())
        assert all(jnp.isinf(search.limit) for search in ready.searches.values())
    gather = mpc.prepared(mpc.Config(env="point_gather", horizon=2))
    assert gather.penalties == {"table": 1, "search": 200}
