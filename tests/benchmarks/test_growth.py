import importlib.util

import numpy as np
import pytest

from benchmarks import growth
from benchmarks.measure import Row


def rows_of(sizes, seconds):
    """One row per size, whose batch takes so long."""
    rates = [size / time for size, time in zip(sizes, seconds, strict=True)]
    return [
        Row("what", "steps", size, rate, rate / 2, 2 * rate, 1.0, 100.0)
        for size, rate in zip(sizes, rates, strict=True)
    ]


def test_the_slope_is_that_of_the_larger_half():
    sizes = [1, 4, 16, 64, 256]
    seconds = [1.0, 1.0, 16.0**1.5, 64.0**1.5, 256.0**1.5]
    found = growth.series("title", "envs", "step", sizes, rows_of(sizes, seconds), 1)
    assert found.fitted == 3
    assert found.slope == pytest.approx(1.5)
    np.testing.assert_allclose(found.seconds, seconds)
    np.testing.assert_allclose(found.fastest, np.asarray(seconds) / 2)
    np.testing.assert_allclose(found.slowest, 2 * np.asarray(seconds))


def test_two_sizes_are_enough_and_units_count():
    found = growth.series("title", "seeds", "iteration", [1, 2], rows_of([1, 2], [3.0, 3.0]), 10)
    assert found.fitted == 2
    assert found.slope == pytest.approx(0)
    np.testing.assert_allclose(found.seconds, [30, 30])


@pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="needs matplotlib")
def test_growth_leaves_a_figure_and_numbers(tmp_path, monkeypatch):
    one = growth.series("title", "envs", "step", [1, 4], rows_of([1, 4], [1.0, 2.0]), 1)
    for name in ("envs", "obstacles", "threats", "side_by_side", "replay"):
        monkeypatch.setattr(growth, name, lambda: one)
    monkeypatch.setattr(growth, "machine", dict)
    monkeypatch.setattr("sys.argv", ["growth", "--out", str(tmp_path / "new")])
    growth.main()
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"growth.json", "growth.png"}
