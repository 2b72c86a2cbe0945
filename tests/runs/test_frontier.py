"""Return and crash rate over x: planners side by side, and one that is told x."""

import dataclasses
import json

import numpy as np
import pytest
from tiny import TINY, TINY_THREAT, programs_of_a_moment  # noqa: F401

from experiments import cli, frontier, jam, training


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    out = tmp_path_factory.mktemp("results") / "frontier"
    words = f"{TINY} {TINY_THREAT.format('obstacle')} --obstacles 3 --test-obstacles 3"
    argv = [*words.split(), "--thresholds", "0.2", "0.9", "--out", str(out)]
    cli.main("frontier", "", frontier.PRESETS, jam.make_task, argv, run=frontier.run)
    return out


def test_each_planner_and_threshold_has_a_row_over_all_seeds(results):
    rows = json.loads((results / "frontier.json").read_text())
    assert [(row["planner"], row["x"]) for row in rows] == [
        (planner, x) for planner in ("separate", "told x") for x in (0.2, 0.9)
    ]
    for row in rows:
        assert (row["variant"], row["seeds"], row["episodes"]) == ("N=3", 2, 32)
        assert row["crash_ci95"][0] <= row["crash_rate"] <= row["crash_ci95"][1]
        assert np.isfinite(row["return_mean"])
    assert (results / "frontier.png").stat().st_size > 10_000


def test_all_members_learn_and_none_acts_inadmissibly(results):
    for name, count in (("separate", 4), ("told", 2)):
        lines = (results / name / "metrics.jsonl").read_text().splitlines()
        history = [json.loads(line) for line in lines]
        assert len(history) % count == 0
        assert sum(row["inadmissible"] for row in history) == 0
    methods = {json.loads(line)["method"] for line in lines}
    assert methods == {"RP, plans (x=1)"}


def test_members_differ_in_threshold_and_seed_alone():
    config = dataclasses.replace(frontier.quick("tuned"), seeds=2, thresholds=(0.1, 0.2))
    assert frontier.members_of(config) == [
        training.Member(0, 0.1, 0.0),
        training.Member(1, 0.1, 0.0),
        training.Member(0, 0.2, 0.0),
        training.Member(1, 0.2, 0.0),
    ]


@pytest.mark.parametrize("thresholds", [(), (0.1,), (0.2, 0.1), (0.1, 0.1), (0.0, 0.1), (0.1, 2.0)])
def test_thresholds_out_of_order_or_range_are_refused(thresholds):
    config = dataclasses.replace(frontier.quick("tuned"), thresholds=thresholds)
    with pytest.raises(ValueError, match=r"^thresholds is "):
        config.validate()
