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
