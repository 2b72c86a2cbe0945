"""Training runs in chunks: several side by side, with their curves, and their checkpoints."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments import console
from rp_jax import storage
from rp_jax.checkpoints import Checkpoints

CHUNKS = 30  # of a training run: points of its curves


class Member(NamedTuple):
    """One of the training runs that go side by side."""

    seed: int
    x: float
    learning_penalty: float


class Learners(NamedTuple):
    """What learns side by side, and how it is told of."""

    members: Sequence[Member]
    names: Sequence[str]  # of their methods
    penalty: float  # taken off the returns per unit of danger
    folder: Path  # for metrics.jsonl
    more: Callable[[Mapping[str, float]], dict[str, Any]] = lambda sums: {}  # columns, of a chunk


class Record(NamedTuple):
    """What happened in each chunk."""

    metrics: dict[str, np.ndarray]  # (chunks, members) sums, by name
    seconds: np.ndarray  # (chunks,) since the beginning, interruptions left out


class Trained(NamedTuple):
    """What training leaves."""

    params: Any  # of the networks that act, leading axis (members,)
    history: list[dict[str, Any]]  # one row per chunk and member
    seconds: float  # of all members together, without compilation
    compile_seconds: float


def learn(
    learners: Learners,
    state: Any,
    metrics: dict[str, np.ndarray],
    step: Callable[[int, Any], tuple[Any, Mapping[str, Any]]],
    check: Callable[[Any, dict[str, np.ndarray]], None],
    weights: Callable[[Any], Any],
    bar: console.Bar,
    checkpoints: Checkpoints,
) -> tuple[Any, list[dict[str, Any]], float]:
    """All chunks, one after another; metrics.jsonl is written as it goes.

    Args:
        learners: what learns.
        state: before the first chunk.
        metrics: by name, (chunks, members): what is counted already, mostly zeros. There must be
            steps, episodes, score, danger, crashes and goals.
        step: (i, state) -> (state after chunk i, its metrics (members,)).
        check: raises FloatingPointError if the weights or a chunk's metrics are no numbers.
        weights: those that act, in a state.
        bar: of the progress.
        checkpoints: of the run.

    Returns:
        (weights, one row per chunk and member, seconds).
    """
    chunks = len(metrics["steps"])
    now = time.perf_counter()

    def tell(record: Record, done: int) -> list[dict[str, Any]]:
        rows = history(learners, record, done)
        write_lines(learners.folder / "metrics.jsonl", rows)
        return rows

    def advance(i: int, carried: tuple[Any, Record]) -> tuple[Any, Record]:
        nonlocal now
        state, record = carried
        state, new = step(i, state)
        for name, whole in record.metrics.items():
            whole[i] += new[name]
        check(weights(state), {name: whole[i] for name, whole in record.metrics.items()})
        now, before = time.perf_counter(), now
        record.seconds[i] = record.seconds[i - 1] + (now - before)  # which float32 can hold
        bar("", i + 1, chunks, note(tell(record, i + 1)[-len(learners.members) :]))
        return state, record

    found, record = checkpoints.loop(
        (state, Record(metrics, np.zeros(chunks, np.float32))),
        advance,
        chunks,
        lambda carried: (weights(carried[0]), carried[1]),
    )
    return found, tell(record, chunks), float(record.seconds[-1])


def history(learners: Learners, record: Record, done: int) -> list[dict[str, Any]]:
    """One row per member and chunk of the `done` first ones."""
    rows = []
    steps = np.cumsum(record.metrics["steps"].astype(int), axis=0)
    for chunk in range(done):
        for i, member in enumerate(learners.members):
            of = {name: float(m[chunk, i]) for name, m in record.metrics.items()}
            ended = max(of["episodes"], 1.0)
            rows.append(
                {
                    "seed": member.seed,
                    "method": learners.names[i],
                    "steps": int(steps[chunk, i]),
                    "episodes": int(of["episodes"]),
                    "return_mean": (of["score"] - learners.penalty * of["danger"]) / ended
                    if of["episodes"]
                    else float("nan"),
                    "danger": of["danger"],
                    "crashes": int(of["crashes"]),
                    "goal_rate": of["goals"] / ended,
                    "seconds": float(record.seconds[chunk]),
                    **learners.more(of),
                }
            )
    return rows


def note(rows: Sequence[Mapping]) -> str:
    """Return and crashes of the last chunk, for the progress bar."""
    ended = [row for row in rows if row["episodes"]]
    if not ended:
        return "no episode ended"
    returns = np.mean([row["return_mean"] for row in ended])
    crashes, count = sum(row["crashes"] for row in ended), sum(row["episodes"] for row in ended)
    return f"return {returns:.1f}, {crashes} crashes in {count} episodes"


def write_lines(path: Path, rows: Sequence[Mapping]) -> None:
    """The whole file each time: no line of it is ever half there, or there twice."""
    plain = [{k: None if v != v else v for k, v in row.items()} for row in rows]
    storage.write_bytes(path, "".join(json.dumps(row) + "\n" for row in plain).encode())
