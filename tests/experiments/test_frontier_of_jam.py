"""The frontier of Jam, as small as it gets."""

import json

import numpy as np
import pytest
from tiny import TINY, TINY_THREAT, programs_of_a_moment  # noqa: F401

from experiments import frontier
from rp_jax.cli import experiment


@pytest.mark.slow
def test_it_leaves_a_table_and_a_figure(tmp_path):
    out = tmp_path / "frontier"
    words = f"{TINY} {TINY_THREAT.format('obstacle')} --obstacles 3 --test-obstacles 3"
    argv = [*words.split(), "--thresholds", "0.2", "0.9", "--out", str(out)]
    assert experiment.run(frontier.EXPERIMENT, argv) == out
    rows = json.loads((out / "frontier.json").read_text())
    assert [(row["planner"], row["x"]) for row in rows] == [
        (planner, x) for planner in ("separate", "told x") for x in (0.2, 0.9)
    ]
    for row in rows:
        assert (row["variant"], row["seeds"], row["episodes"]) == ("N=3", 2, 32)
        assert np.isfinite(row["return_mean"])
    assert (out / "frontier.png").stat().st_size > 10_000
    lines = (out / "separate" / "metrics.jsonl").read_text().splitlines()
    methods = {json.loads(line)["method"] for line in lines}
    assert methods == {"RP, plans (x=0.2)", "RP, plans (x=0.9)"}


@pytest.mark.parametrize("thresholds", [["0.1"], ["0.2", "0.1"], ["0.0", "0.1"]])
def test_thresholds_are_refused_before_any_work(thresholds, tmp_path, capsys):
    out = tmp_path / "new"
    words = ["--thresholds", *thresholds, "--out", str(out)]
    with pytest.raises(SystemExit, match="2"):
        experiment.run(frontier.EXPERIMENT, words)
    assert "thresholds is" in " ".join(capsys.readouterr().out.split())
    assert not out.exists()
