"""Learning in chunks, with a learner that only counts."""

import json

import numpy as np
import pytest

from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints, equal_chunks
from rp_jax.runs import training
from rp_jax.runs.agents import Member

COUNTED = ("steps", "episodes", "score", "danger", "crashes", "goals")
MEMBERS = [Member(3, 0.1, 0.0), Member(4, 0.1, 0.0)]


@pytest.mark.parametrize("units", [1, 7, 30, 31, 1000])
def test_chunks_hold_all_units_and_few_more(units):
    chunks, length = equal_chunks(units, training.CHUNKS)
    assert chunks <= training.CHUNKS
    assert units <= chunks * length < units + length


def learn(folder, checkpoints=NO_CHECKPOINTS, chunks=4, fails_at=None, **told):
    """Member i has i episodes a chunk, each of 10 points and half a crash."""
    each = np.asarray([0.0, 1.0], np.float32)
    blank = {name: np.zeros((chunks, 2), np.float32) for name in COUNTED}

    def step(i, state):
        sums = (each + 5, each, 10 * each, each / 2, each, 0 * each)
        return state + 1, dict(zip(COUNTED, sums, strict=True))

    def check(weights, sums):
        assert sums["steps"].shape == (2,)
        if weights == fails_at:
            raise FloatingPointError(f"chunk {fails_at}")

    more = lambda sums: {"per step": sums["score"] / sums["steps"]}  # noqa: E731
    learners = training.Learners(MEMBERS, ["a", "b"], 4.0, folder, more=more, **told)
    state = np.asarray(0)
    return training.learn(learners, state, blank, step, check, lambda s: s, checkpoints)


def test_each_chunk_and_member_has_a_row(tmp_path):
    weights, rows, seconds = learn(tmp_path)
    assert weights == 4
    assert seconds >= 0
    assert [(row["seed"], row["method"]) for row in rows] == 4 * [(3, "a"), (4, "b")]
    assert [row["steps"] for row in rows[1::2]] == [6, 12, 18, 24]
    assert all(row["return_mean"] == 10 - 4 * 0.5 for row in rows[1::2])
    assert all(row["per step"] == pytest.approx(10 / 6) for row in rows[1::2])
    written = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert written[1::2] == rows[1::2]
    assert written[0]["return_mean"] is None  # no episode ended, and JSON knows no nan
    assert np.isnan(rows[0]["return_mean"])


def test_counts_are_told_as_they_are():
    """Where single precision would round them, over chunks that add up to 2e9."""
    chunk = {"steps": 999_999_999, "episodes": 33_333_333, "crashes": 16_777_217, "goals": 5}
    metrics = {name: np.full((2, 2), count, np.int32) for name, count in chunk.items()}
    metrics |= {name: np.zeros((2, 2), np.float32) for name in ("score", "danger")}
    tape = training.Tape(metrics, np.zeros(2, np.float32))
    rows = training.history(training.Learners(MEMBERS, ["a", "b"], 0.0, None), tape, 2)
    assert [row["steps"] for row in rows] == 2 * [999_999_999] + 2 * [1_999_999_998]
    assert {(row["episodes"], row["crashes"]) for row in rows} == {(33_333_333, 16_777_217)}
    assert all(type(row[name]) is int for row in rows for name in ("steps", "episodes", "crashes"))


def test_progress_and_rows_are_told_as_they_come():
    said, rows = [], []
    learn(None, on_progress=lambda *of: said.append(of), on_metrics=rows.append, stage="counting")
    assert [of[:3] for of in said] == [("counting", i, 4) for i in range(1, 5)]
    assert said[0][3] == "return 8.0, 1 crashes in 1 episodes"
    assert [(row["seed"], row["steps"]) for row in rows[:4]] == [(3, 5), (4, 6), (3, 10), (4, 12)]


def test_what_is_no_number_stops_it_and_it_goes_on_from_there(tmp_path, monkeypatch):
    monkeypatch.setattr("rp_jax.checkpoints.INTERVAL", 0.0)
    monkeypatch.setattr("rp_jax.checkpoints.SHARE", float("inf"))
    checkpoints = Checkpoints(tmp_path / "checkpoints", say=lambda text: None)
    with pytest.raises(FloatingPointError, match="chunk 3"):
        learn(tmp_path, checkpoints, fails_at=3)
    assert len((tmp_path / "metrics.jsonl").read_text().splitlines()) == 4
    weights, rows, _ = learn(tmp_path, checkpoints)
    assert (weights, len(rows)) == (4, 8)
    assert rows[-1]["steps"] == 24
