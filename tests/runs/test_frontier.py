"""Return and crash rate over x, on the corridor: agents side by side, and agents told x."""

import json

import jax
import numpy as np
import probe
import pytest

from rp_jax.planning.loop import LoopConfig
from rp_jax.runs.frontier import SEPARATE, TOLD, check_thresholds, frontier, over_seeds
from rp_jax.threat.function import ThreatFunction

PLANNING = LoopConfig(steps=400, num_envs=8, batch=16, n_step=2, replay=128, replay_start=16)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """All rows, and the folder that they were made in."""
    params, folder = probe.make_params(), tmp_path_factory.mktemp("frontier")
    threat = ThreatFunction({"pit": probe.threat_model(params)}, probe.sub_rmdps(params))
    with jax.numpy_rank_promotion("allow"):
        rows = frontier(
            jax.random.key(0),
            probe,
            params,
            threat,
            thresholds=(0.2, 0.9),
            tests={"slip .1": params, "slip .5": probe.make_params(slip=0.5)},
            seeds=2,
            config=PLANNING,
            episodes=16,
            folder=folder,
        )
    return rows, folder


@pytest.mark.slow
def test_each_kind_of_agent_test_and_threshold_has_a_row_over_all_seeds(made):
    rows, _ = made
    assert [(row["planner"], row["variant"], row["x"]) for row in rows] == [
        *((SEPARATE, test, x) for test in ("slip .1", "slip .5") for x in (0.2, 0.9)),
        *((TOLD, test, x) for test in ("slip .1", "slip .5") for x in (0.2, 0.9)),
    ]
    for row in rows:
        assert (row["seeds"], row["episodes"]) == (2, 32)
        assert row["crash_ci95"][0] <= row["crash_rate"] <= row["crash_ci95"][1]
        assert np.isfinite(row["return_mean"])
        assert 0 <= row["insecure"] <= 1


@pytest.mark.slow
def test_all_agents_learn_and_none_acts_inadmissibly(made):
    _, folder = made
    for name, count in (("separate", 4), ("told", 2)):
        lines = (folder / name / "metrics.jsonl").read_text().splitlines()
        history = [json.loads(line) for line in lines]
        assert len(history) % count == 0
        assert sum(row["inadmissible"] for row in history) == 0
        first = history[:count]
        seeds, methods = [row["seed"] for row in first], [row["method"] for row in first]
        assert seeds == [0, 1] * (count // 2)
        of = {"separate": ["RP (x=0.2)"] * 2 + ["RP (x=0.9)"] * 2, "told": ["RP (x=0.9)"] * 2}
        assert methods == of[name]


def test_rows_are_pooled_over_seeds_alone():
    row = {"planner": "a", "variant": "b", "x": 0.1, "insecure": 0.2, "return_mean": 1.0}
    row |= {"return_ci95": 0.5, "episodes": 10, "crashes": 1}
    found = over_seeds([row, {**row, "x": 0.2}, {**row, "insecure": 0.4, "return_mean": 3.0}])
    assert [(of["x"], of["seeds"], of["return_mean"]) for of in found] == [(0.1, 2, 2), (0.2, 1, 1)]
    assert found[0]["insecure"] == pytest.approx(0.3)


@pytest.mark.parametrize("thresholds", [(), (0.1,), (0.2, 0.1), (0.1, 0.1), (0.0, 0.1), (0.1, 2.0)])
def test_thresholds_out_of_order_or_range_are_refused(thresholds):
    with pytest.raises(ValueError, match=r"^thresholds is "):
        check_thresholds(thresholds)
