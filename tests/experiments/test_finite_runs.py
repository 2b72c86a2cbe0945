"""Experiments on finite CMDPs: Frozen Lake and the theorems."""

import json
import sys

import jax
import numpy as np
import pytest

from experiments import frozen_lake, theorems
from rp_jax.tabular import thresholds


@pytest.fixture(scope="module")
def results():
    config = frozen_lake.Config(horizons=(12,), c=(0.05, 0.3), curve=(0.1,))
    with jax.enable_x64(True):
        return frozen_lake.run(config)


def test_a_row_for_each_lake_baseline_rule_and_bound(results):
    rows = results["rows"]
    assert len(rows) == 2 * 4 * len(thresholds.RULES) * 3
    for row in rows:
        if row["safe_baseline"]:
            assert row["worst_danger"] <= row["c"] + 1e-9
            assert row["danger"] <= row["worst_danger"] + 1e-12
            assert row["return_mean"] <= row["optimum"] + 1e-9
        else:
            assert row["baseline"] != "eta*"
            assert row["return_mean"] is row["x"] is row["share"] is None


def test_the_optimum_is_found_twice(results):
    assert len(results["programs"]) == 2
    for row in results["programs"]:
        assert abs(row["difference"]) < 1e-8
    for row in results["optima"]:
        assert row["lagrangian"] <= row["optimum"] + 1e-12
        assert row["lagrangian_danger"] <= row["c"]


def test_the_command_writes_tables_and_figures(tmp_path, monkeypatch, capsys):
    out = tmp_path / "run"
    words = ["--out", str(out), "--horizons", "5", "--c", "0.1", "--curve", "0.2"]
    monkeypatch.setattr(sys, "argv", ["frozen_lake", *words])
    frozen_lake.main()
    names = {"config.json", "table.json", "optima.json"}
    names |= {"figure_2.png", "figure_3.png", "rules.png"}
    assert {path.name for path in out.iterdir()} == names
    rows = json.loads((out / "table.json").read_text())
    assert {row["rule"] for row in rows} == set(thresholds.RULES)
    assert json.loads((out / "config.json").read_text())["horizons"] == [5]
    assert "the optimum, twice" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["frozen_lake", *words])
    with pytest.raises(SystemExit, match="2"):
        frozen_lake.main()  # the folder exists


@pytest.mark.parametrize(
    ("module", "field", "value"),
    [
        (frozen_lake, "horizons", ()),
        (frozen_lake, "horizons", (0,)),
        (frozen_lake, "c", (-1.0,)),
        (frozen_lake, "curve", (float("nan"),)),
        (frozen_lake, "slip", 2.0),
        (theorems, "instances", 0),
        (theorems, "states", -1),
        (theorems, "actions", 32),
        (theorems, "seed", -1),
    ],
)
def test_settings_out_of_range_are_named(module, field, value):
    with pytest.raises(ValueError, match=f"^{field} is "):
        module.Config(**{field: value}).validate()


def test_violations_are_counted_and_fail_the_command(monkeypatch, capsys, tmp_path):
    def broken(config, horizon):
        return {"any": lambda key: {"wrong": jax.random.uniform(key)}}

    monkeypatch.setattr(theorems, "programs", broken)
    monkeypatch.setattr(theorems, "BATCH", 30)
    rows = theorems.run(theorems.Config(instances=400))
    assert [row["horizon"] for row in rows] == list(theorems.HORIZONS)
    assert all(row["instances"] == row["violations"] == 100 for row in rows)
    out = tmp_path / "rows.json"
    monkeypatch.setattr(sys, "argv", ["theorems", "--instances", "8"])
    with pytest.raises(SystemExit, match="1"):
        theorems.main()
    monkeypatch.setattr(sys, "argv", ["theorems", "--instances", "8", "--out", str(out)])
    theorems.main()  # who reads the file sees them
    assert len(json.loads(out.read_text())) == 4
    assert "violations" in capsys.readouterr().out


def test_nan_is_a_violation():
    found = theorems.counted([np.asarray([0.0, np.nan]), np.asarray([-1.0, 1e-3])])
    assert found["instances"] == 4
    assert found["violations"] == 2
