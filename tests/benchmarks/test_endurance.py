import dataclasses
import json
import sys

import jax
import numpy as np
import probe
import pytest
from quick import compile_soon  # noqa: F401

from benchmarks import endurance
from rp_jax.planning.loop import LoopConfig
from rp_jax.threat.build import ThreatConfig


@dataclasses.dataclass(frozen=True)
class Settings:
    planning: LoopConfig
    pit: ThreatConfig


@pytest.fixture
def corridor(monkeypatch):
    """The corridor in place of a task, chunks of a moment."""
    config = LoopConfig(steps=64, num_envs=8, batch=8, n_step=1, replay=64, replay_start=8)
    pmdp = probe.make_pmdp(probe, probe.make_params())
    settings = Settings(config, ThreatConfig())
    monkeypatch.setattr(endurance.setups, "quick_tasks", lambda: {"jam": (None, settings)})
    monkeypatch.setattr(endurance.setups, "pmdp_of", lambda *_: pmdp)
    monkeypatch.setattr(endurance, "CHUNK", 2)
    with jax.numpy_rank_promotion("allow"):
        yield


def test_traces_steps_and_inadmissible_actions_are_counted(corridor):
    rows = list(endurance.train(endurance.Config(minutes=60, steps=80)))
    assert [row["steps"] for row in rows] == [24, 40, 56, 72, 88]
    assert [row["traces"] for row in rows] == [1] * 5
    assert [row["inadmissible"] for row in rows] == [0] * 5
    assert all(row["megabytes"] > 10 for row in rows)


def test_what_was_measured_is_written_on_the_way(corridor, tmp_path, monkeypatch):
    out = tmp_path / "found.json"
    written = []
    monkeypatch.setattr(endurance, "EVERY", 2)
    write = endurance.storage.write_json
    monkeypatch.setattr(
        endurance.storage, "write_json", lambda *of: (write(*of), written.append(of[1]["steps"]))
    )
    monkeypatch.setattr(sys, "argv", ["endurance", "--steps", "80", "--out", str(out)])
    endurance.main()
    assert written == [24, 56, 88, 88]
    assert json.loads(out.read_text())["steps"] == 88


def test_what_is_compiled_again_ends_it_with_1(monkeypatch):
    row = {"minutes": 1.0, "steps": 1, "inadmissible": 0, "megabytes": 1.0, "traces": 2}
    monkeypatch.setattr(endurance, "train", lambda _: iter([row]))
    monkeypatch.setattr(sys, "argv", ["endurance"])
    with pytest.raises(SystemExit) as stop:
        endurance.main()
    assert stop.value.code == 1


def test_growth_is_the_slope_of_the_second_half():
    minutes = np.arange(0.0, 121.0, 10.0)
    rows = [{"minutes": m, "megabytes": 500.0 + (0 if m < 50 else 0.1 * m)} for m in minutes]
    found = endurance.summary(rows)
    assert found["megabytes_per_hour"] == pytest.approx(6.0)
    assert found["hours_of_second_half"] == pytest.approx(50 / 60)
    assert endurance.summary(rows[:2])["megabytes_per_hour"] is None


def test_fewer_steps_than_environments_are_refused(corridor, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["endurance", "--steps", "7"])
    with pytest.raises(SystemExit) as stop:
        endurance.main()
    assert stop.value.code == 2
    assert "steps is 7; it must be" in capsys.readouterr().out
