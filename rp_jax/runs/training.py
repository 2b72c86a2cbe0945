"""Learning in chunks: several agents side by side, with their curves and their checkpoints."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rp_jax import storage
from rp_jax.checkpoints import Checkpoints
from rp_jax.runs.agents import Member
from rp_jax.runs.progress import OnMetrics, OnProgress, silent

CHUNKS = 30  # of a training run: points of its curves


class Learners(NamedTuple):
    """Learners that train side by side, and where their progress is told."""

    members: Sequence[Member]
    names: Sequence[str]  # of their methods
    penalty: float  # taken off the returns that are told, per unit of danger
    folder: Path | None  # for metrics.jsonl; None: it is not written
    on_progress: OnProgress = silent
    on_metrics: OnMetrics = silent  # called with the rows of each chunk, one by one
    more: Callable[[Mapping[str, float]], dict[str, Any]] = lambda sums: {}  # columns of a chunk
    stage: str = "planning"  # named in the progress


class Tape(NamedTuple):
    """Sums over each chunk of training."""

    metrics: dict[str, np.ndarray]  # (chunks, members) sums, by name
    seconds: np.ndarray  # (chunks,) since the beginning, interruptions left out


def learn(
    learners: Learners,
    state: Any,
    metrics: dict[str, np.ndarray],
    step: Callable[[int, Any], tuple[Any, Mapping[str, Any]]],
    check: Callable[[Any, dict[str, np.ndarray]], None],
    weights: Callable[[Any], Any],
    checkpoints: Checkpoints,
) -> tuple[Any, list[dict[str, Any]], float]:
    """Learns chunk by chunk; metrics.jsonl is written as it goes.

    Args:
        learners: what learns.
        state: before the first chunk.
        metrics: by name, (chunks, members): what is counted already, mostly zeros. There must be
            steps, episodes, score, danger, crashes and goals.
        step: (i, state) -> (state after chunk i, its metrics (members,)).
        check: raises FloatingPointError if the weights or a chunk's metrics are no numbers.
        weights: those that act, in a state.
        checkpoints: of the learning.

    Returns:
        (weights, one row per chunk and member, seconds).
    """
    chunks = len(metrics["steps"])
    now = time.perf_counter()

    def tell(tape: Tape, done: int) -> list[dict[str, Any]]:
        rows = history(learners, tape, done)
        if learners.folder is not None:
            write_lines(learners.folder / "metrics.jsonl", rows)
        return rows

    def advance(i: int, carried: tuple[Any, Tape]) -> tuple[Any, Tape]:
        nonlocal now
        state, tape = carried
        state, new = step(i, state)
        for name, whole in tape.metrics.items():
            whole[i] += new[name]
        check(weights(state), {name: whole[i] for name, whole in tape.metrics.items()})
        now, before = time.perf_counter(), now
        tape.seconds[i] = tape.seconds[i - 1] + (now - before)  # which float32 can hold
        rows = tell(tape, i + 1)[-len(learners.members) :]
        learners.on_progress(learners.stage, i + 1, chunks, note(rows))
        for row in rows:
            learners.on_metrics(row)
        return state, tape

    found, tape = checkpoints.loop(
        (state, Tape(metrics, np.zeros(chunks, np.float32))),
        advance,
        chunks,
        lambda carried: (weights(carried[0]), carried[1]),
    )
    return found, tell(tape, chunks), float(tape.seconds[-1])


def history(learners: Learners, tape: Tape, done: int) -> list[dict[str, Any]]:
    """Returns one row per agent and chunk, of the first chunks.

    Args:
        learners: whose they are.
        tape: of all chunks.
        done: how many chunks there were.
    """
    rows = []
    steps = np.cumsum(tape.metrics["steps"], axis=0, dtype=np.int64)
    for chunk in range(done):
        for i, member in enumerate(learners.members):
            of = {name: m[chunk, i].item() for name, m in tape.metrics.items()}
            ended = max(of["episodes"], 1)
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
                    "seconds": float(tape.seconds[chunk]),
                    **learners.more(of),
                }
            )
    return rows


def note(rows: Sequence[Mapping]) -> str:
    """Returns what is said of a chunk beside its progress: return and crashes.

    Args:
        rows: of the chunk.
    """
    ended = [row for row in rows if row["episodes"]]
    if not ended:
        return "no episode ended"
    returns = np.mean([row["return_mean"] for row in ended])
    crashes, count = sum(row["crashes"] for row in ended), sum(row["episodes"] for row in ended)
    return f"return {returns:.1f}, {crashes} crashes in {count} episodes"


def write_lines(path: Path, rows: Sequence[Mapping]) -> None:
    """Writes a file with a JSON object per line, whole each time: no line is half there or twice.

    Args:
        path: of the file.
        rows: (n,) tables.
    """
    plain = [{k: None if v != v else v for k, v in row.items()} for row in rows]
    storage.write_bytes(path, "".join(json.dumps(row) + "\n" for row in plain).encode())
