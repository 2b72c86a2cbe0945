"""Tree search as a job, in Jam one step ahead."""

import jax
import numpy as np
import pytest
from quick import compile_soon, stopped_after  # noqa: F401

from rp_jax import storage
from rp_jax.baselines.mpc import make_search
from rp_jax.envs import jam
from rp_jax.runs import tree_search
from rp_jax.runs.tree_search import evaluate_search, method_name, play_search

MEASURED = ("seconds_per_100_actions", "cpu_seconds_per_100_actions")
MEASURED += ("seconds_per_100_actions_in_batch",)


def search_among(count):
    return make_search(jam, jam.make_params(num_obstacles=count), 1, 50.0)


def untimed(table):
    return [{k: v for k, v in row.items() if k not in MEASURED} for row in storage.plain(table)]


def test_it_goes_on_where_it_was_interrupted_and_keeps_whole_tests(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tree_search, "GROUP", 2)
    searches = {"N=1": search_among(1), "N=2": search_among(2)}
    evaluated = lambda folder: evaluate_search(  # noqa: E731
        jax.random.key(0), searches, episodes=5, penalty=50.0, folder=folder
    )
    at_once = evaluated(tmp_path / "at_once").rows
    assert [row["variant"] for row in at_once] == ["N=1", "N=2"]
    assert all(row["episodes"] == 5 for row in at_once)
    assert all(row[name] > 0 for row in at_once for name in MEASURED)
    with stopped_after(3, monkeypatch), pytest.raises(KeyboardInterrupt):  # the last of N=1
        evaluated(tmp_path / "apart")
    assert untimed(evaluated(tmp_path / "apart").rows) == untimed(at_once)
    assert "MPC test N=1: 3 of 3 were done" in capsys.readouterr().out
    assert not (tmp_path / "apart" / "checkpoints").exists()


def test_only_the_episodes_asked_for_are_given(monkeypatch):
    monkeypatch.setattr(tree_search, "GROUP", 2)
    said = []
    rows, seconds = play_search(
        jax.random.key(0), search_among(1), 3, on_progress=lambda *of: said.append(of)
    )
    assert rows.score.shape == (3,)
    assert np.isfinite(seconds)
    assert [of[:3] for of in said] == [("search", done, 3) for done in (0, 2, 3)]


def test_names_tell_steps_and_limit():
    search = search_among(1)
    assert method_name(search) == "MPC (1 step)"
    assert method_name(search.replace(limit=np.float32(0.25))) == "MPC (1 step, x=0.25)"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"episodes": 0}, "episodes is 0"),
        ({"penalty": -1.0}, "penalty is -1"),
        ({"searches": {}}, r"searches is \{\}; it must have at least one"),
    ],
)
def test_bad_settings_are_named(changes, message, tmp_path):
    settings = {"searches": {"N=1": search_among(1)}, **changes}
    with pytest.raises(ValueError, match=f"^{message}"):
        evaluate_search(jax.random.key(0), folder=tmp_path / "new", **settings)
    assert not (tmp_path / "new").exists()
