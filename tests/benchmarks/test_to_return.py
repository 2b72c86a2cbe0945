import json
import sys

import jax
import pytest
from quick import compile_soon  # noqa: F401

from benchmarks import to_return

ROW = {
    "variant": "default",
    "crash_ci95": [0.0, 0.1],
    "return_ci95": 1.0,
    "episodes": 50,
}


def test_the_first_budget_with_which_all_seeds_pass_is_named(tmp_path, monkeypatch, capsys):
    earned = {(1000, 0): (1440, 0), (1000, 1): (1400, 0)}
    earned |= {(2000, 0): (1440, 1), (2000, 1): (1450, 0)}  # one of 50 is too often
    earned |= {(4000, 0): (1440, 0), (4000, 1): (1441, 0)}

    def learned(run, threat, budget, seed, bar):
        assert list(run.world.tests) == ["default"]
        assert run.process.threat is threat is None
        score, crashes = earned[budget, seed]
        crashed = {"crashes": crashes, "crash_rate": crashes / 50}
        took = {"budget": budget, "seconds": budget / 1000, "compile_seconds": 7.0}
        return ROW | took | {"return_mean": score, **crashed, "seed": seed}

    monkeypatch.setattr(to_return, "learned", learned)
    monkeypatch.setattr(to_return.train, "threat_of", lambda *_: None)
    out = tmp_path / "found.json"
    words = ["--budgets", "1000", "2000", "4000", "--seeds", "2", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["to_return", "--env", "circuit", *words])
    to_return.main()
    shown = capsys.readouterr().out
    assert "all seeds past it: 4.0 s (4,000 steps)" in shown
    for past in ("past 1439, and less than 0.5 % crashes", "1 of 2", "2 of 2"):
        assert past in shown
    found = json.loads(out.read_text())
    assert [row["seconds"] for row in found["rows"]] == [1, 1, 2, 2, 4, 4]
    assert found["threat_seconds"] >= 0


@pytest.mark.slow
def test_a_budget_is_learned_with_and_judged_on_the_learned_variant():
    config = to_return.Config("jam", budgets=(300,), num_envs=16, batch=16, episodes=8)
    run = to_return.prepared(config)
    told = []
    with jax.numpy_rank_promotion("allow"):
        row = to_return.learned(run, None, 6000, 3, lambda *of: told.append(of[0]))
    assert (row["budget"], row["seed"], row["variant"]) == (6000, 3, "N=8")
    assert row["episodes"] == 8
    assert row["seconds"] > 0
    assert row["compile_seconds"] > 0
    assert set(told) == {"planning", "evaluation N=8"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--env", "point_gather"), "env is 'point_gather'; it must be one of 'jam', 'circuit'"),
        (("--budgets",), "budgets is (); it must have at least one value"),
        (("--budgets", "10"), "budgets.steps is 10; it must be"),
        (("--out", "nowhere/it.json"), "out is nowhere/it.json; its folder must exist"),
        (("--seeds", "0"), "seeds is 0; it must be"),
    ],
)
def test_bad_input_is_named(words, message, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["to_return", *words])
    with pytest.raises(SystemExit, match="2"):
        to_return.main()
    assert message in capsys.readouterr().out
