import pytest

from rp_jax.runs import tables


def test_seeds_are_summed_up_by_hand():
    row = {"variant": "a", "seed": 0, "episodes": 10, "crashes": 1, "return_mean": 1.0}
    row["return_ci95"] = 0.5
    rows = [row, {**row, "seed": 1, "return_mean": 3.0, "crashes": 0}, {**row, "variant": "b"}]
    both, single = tables.over_seeds(rows)
    assert (both["variant"], both["seeds"]) == ("a", 2)
    assert both["return_mean"] == 2.0
    assert both["return_ci95"] == pytest.approx(12.7062, rel=1e-4)  # t(.975, 1) x 1
    assert (both["crashes"], both["episodes"], both["crash_rate"]) == (1, 20, 0.05)
    assert both["crash_ci95"][0] < 0.05 < both["crash_upper95"] < both["crash_ci95"][1]
    assert (single["variant"], single["seeds"]) == ("b", 1)
    assert single["return_ci95"] == 0.5  # over its episodes


def test_a_row_is_told_in_words():
    row = {"episodes": 20_000, "return_mean": 76.549, "return_ci95": 0.271, "crashes": 244}
    row |= {"uncrashed_return_mean": 77.0, "crash_rate": 0.0122, "crash_ci95": [0.0107, 0.0138]}
    row |= {"danger_mean": 0.0122, "goal_rate": 0.98, "interventions": 0.25, "insecure": 0.0}
    row |= {"collisions": {"wall": 0, "obstacle": 1_244}, "train_seconds": 61.234}
    assert tables.in_words(row) == {
        "episodes": "20,000",
        "return, mean +- half of its 95 % interval": "76.55 +- 0.27",
        "return of episodes without danger, mean": "77.00",
        "crashes": "244 of 20,000",
        "crash rate, % [exact 95 % interval]": "1.220 [1.070, 1.380]",
        "danger of an episode, mean": "0.0122",
        "goal reached, % of episodes": "98.000",
        "action changed by the shield, % of steps": "25.000",
        "no admissible action, % of steps": "0.000",
        "learning, seconds": "61.23",
        "what was hit": "obstacle 1,244",
    }
    crashed = {**row, "uncrashed_return_mean": float("nan"), "collisions": {"wall": 0}}
    told = tables.in_words(crashed)
    assert told["return of episodes without danger, mean"] == "-"
    assert told["what was hit"] == "nothing"
