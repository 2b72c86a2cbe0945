import pytest

from rp_jax import statistics
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
    assert both["method_crash_ci95"][1] > both["crash_ci95"][1]
    assert both["method_crash_upper95"] < both["method_crash_ci95"][1]
    assert (both["threats"], single["method_crash_ci95"]) == (1, None)
    assert (single["variant"], single["seeds"]) == ("b", 1)
    assert single["return_ci95"] == 0.5  # over its episodes


def test_agents_of_several_threat_functions_are_clusters():
    row = {"variant": "a", "episodes": 1000, "return_ci95": 0.5}
    agents = [("x", 1.0, 2), ("x", 2.0, 4), ("y", 5.0, 10), ("y", 6.0, 8)]
    rows = [
        {**row, "threat": threat, "seed": i, "return_mean": mean, "crashes": crashes}
        for i, (threat, mean, crashes) in enumerate(agents)
    ]
    (found,) = tables.over_seeds(rows)
    assert (found["threats"], found["seeds"], found["crashes"]) == (2, 2, 24)
    assert found["return_ci95"] == pytest.approx(12.7062 * 2, rel=1e-4)  # of 1.5 and 5.5
    wanted = statistics.cluster_interval([6, 18], [2000, 2000])
    assert found["method_crash_ci95"] == list(wanted)
    split = tables.split_chance(rows)
    assert (split["return"].within, split["return"].between) == (0.5, 7.75)
    assert split["logit of the crash rate"].share > 0.5
    with pytest.raises(ValueError, match="at least 2 groups"):
        tables.split_chance(rows[:2])


def test_both_intervals_are_told_apart():
    row = {"crash_rate": 0.01, "crash_ci95": (0.005, 0.02), "method_crash_ci95": (0.0, 0.05)}
    assert tables.rates(row) == {
        tables.RATE: "1.000 [0.500, 2.000]",
        tables.METHOD_RATE: "[0.000, 5.000]",
    }
    assert tables.rates({**row, "method_crash_ci95": None})[tables.METHOD_RATE] == ""
    assert tables.method_interval(row) == (0.0, 0.05)
    assert tables.method_interval({"crash_ci95": (0.005, 0.02)}) == (0.005, 0.02)


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
