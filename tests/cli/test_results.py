"""Tables of a run on the terminal: every text of the user as it is, every fact in words."""

import pytest

from rp_jax.cli import results, terminal
from rp_jax.runs.tables import Table

ODD = "fog [light] a_b"
ROW = {
    "env": "my_world [v2]",
    "variant": ODD,
    "method": "RP (x=0.01)",
    "seed": 0,
    "episodes": 10_000,
    "return_mean": 80.333,
    "return_ci95": 0.03,
    "uncrashed_return_mean": 80.4,
    "crashes": 6,
    "crash_rate": 6e-4,
    "crash_ci95": [2.2e-4, 1.306e-3],
    "crash_upper95": 1.18e-3,
    "danger_mean": 6e-4,
    "goal_rate": 0.9994,
    "interventions": 0.0125,
    "insecure": 0.001,
    "collisions": {"wall [b]": 1_234, "obstacle": 5},
}


@pytest.fixture
def shown(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "200")
    terminal.console.cache_clear()
    yield lambda: " ".join(capsys.readouterr().out.split())
    terminal.console.cache_clear()


def test_a_table_of_results_is_in_words_with_units(shown):
    results.show_table(Table([ROW]))
    said = shown()
    for part in (
        "my_world [v2]: RP (x=0.01)",
        f"{ODD} agent 0",
        "return, mean +- half of its 95 % interval │ 80.33 +- 0.03",
        "crashes │ 6 of 10,000",
        "crash rate, % [exact 95 % interval] │ 0.060 [0.022, 0.131]",
        "goal reached, % of episodes │ 99.940",
        "action changed by the shield, % of steps │ 1.250",
        "no admissible action, % of steps │ 0.100",
        "what was hit │ wall [b] 1,234, obstacle 5",
    ):
        assert part in said
    assert not [name for name in ROW if "_" in name and name in said]


def test_several_agents_are_summed_up(shown):
    results.show_table(Table([ROW, {**ROW, "seed": 1, "crashes": 0, "crash_rate": 0.0}]))
    said = shown()
    assert f"{ODD} │ 80.33 +- 0.00 │ 6 of 20,000 │ 0.030 [0.011, 0.065]" in said


def test_errors_of_threat_models_are_in_words(shown):
    row = {"hazard": "wall [b]", "of": "one", "mae": 0.01, "rmse": 0.02, "bias": 0.005}
    row |= {"spearman": 0.99, "unsafe_called_safe": 0.001, "safe_called_unsafe": 0.02}
    results.show_threats([{**row, "states_missed": 1, "unsafe_states": 900}], 0.01)
    said = shown()
    assert "wall [b] │ one │ 0.0100 │ 0.0200 │ 0.0050 │ 0.9900 │ 0.10 % │ 2.00 % │ 1 of 900" in said
    assert not {"mae", "rmse", "spearman"} & set(said.split())
