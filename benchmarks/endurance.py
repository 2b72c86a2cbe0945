"""Long runs: whether memory grows, programs are compiled again, or the shield ever fails.

python -m benchmarks.endurance --minutes 120
python -m benchmarks.endurance --steps 100000000
"""

import dataclasses
import resource
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from benchmarks import setups
from rp_jax import storage
from rp_jax.cli import errors, terminal
from rp_jax.planning import loop
from rp_jax.planning.pmdp import PMDP
from rp_jax.validate import number, one_of

CHUNK = 200  # iterations
EVERY = 50  # chunks between two reports


@dataclass(frozen=True)
class Config:
    """How long; the first of the two that is reached ends it."""

    minutes: float = 2.0
    steps: int = 100_000_000  # of the environment, shielded, while learning
    env: str = "jam"  # or circuit
    out: Path | None = None  # file for what was measured, kept up to date on the way


def memory() -> float:
    """MB of this process in memory now; the most so far, where the system tells no more."""
    status = Path("/proc/self/status")
    if status.exists():
        (line,) = [line for line in status.read_text().splitlines() if line.startswith("VmRSS")]
        return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def train(config: Config) -> Iterator[dict[str, float]]:
    """One row per chunk: minutes, steps, inadmissible actions, memory, and traces so far.

    Raises:
        FloatingPointError: something is no longer a finite number.
    """
    world, settings = setups.quick_tasks()[config.env]
    pmdp = setups.pmdp_of(world, settings)
    learning = dataclasses.replace(settings.planning, steps=config.steps)
    traces = 0

    def counted(state: loop.LoopState, pmdp: PMDP) -> tuple[loop.LoopState, loop.LoopMetrics]:
        nonlocal traces
        traces += 1
        return loop.chunk(state, pmdp, learning, CHUNK)

    chunk = jax.jit(counted, donate_argnums=0)
    init = jax.jit(lambda key, pmdp: loop.init(key, pmdp, learning))
    state, metrics = init(jax.random.key(0), pmdp)
    began, steps, wrong = time.monotonic(), int(metrics.steps), int(metrics.inadmissible)
    while True:
        state, metrics = chunk(state, pmdp)
        steps += int(metrics.steps)
        wrong += int(metrics.inadmissible)
        loop.check(state.learner.params, jax.tree.map(np.asarray, metrics))
        yield {
            "minutes": (time.monotonic() - began) / 60,
            "steps": steps,
            "inadmissible": wrong,
            "megabytes": memory(),
            "traces": traces,
        }
        if steps >= config.steps or time.monotonic() - began >= 60 * config.minutes:
            return


def summary(rows: Sequence[dict[str, float]]) -> dict[str, Any]:
    """The last row, and how memory grew in the second half of the time.

    `megabytes_per_hour` is the slope of a least-squares line, None over fewer than three rows.
    """
    half = [row for row in rows if row["minutes"] > rows[-1]["minutes"] / 2]
    hours = np.asarray([row["minutes"] for row in half]) / 60
    memory = np.asarray([row["megabytes"] for row in half])
    slope = None
    if len(half) > 2:
        away = hours - hours.mean()
        slope = float(away @ memory / (away @ away))
    return {**rows[-1], "megabytes_per_hour": slope, "hours_of_second_half": float(np.ptp(hours))}


def main() -> None:
    """Exits with 1 if an inadmissible action was taken or something was compiled again."""
    config = tyro.cli(Config, prog="python -m benchmarks.endurance", description=__doc__)
    with errors.bad_input():
        offered = setups.quick_tasks()
        _, settings = offered[one_of("env", config.env, offered)]
        number("minutes", config.minutes, above=0)
        number("steps", config.steps, least=settings.planning.num_envs, integer=True)
    rows: list[dict[str, float]] = []

    def report() -> dict[str, Any]:
        found = summary(rows)
        known = {name: value for name, value in found.items() if value is not None}
        terminal.say("  ".join(f"{name} {value:,.6g}" for name, value in known.items()))
        if config.out is not None:
            storage.write_json(config.out, found)
        return found

    for row in train(config):
        rows.append(row)
        if len(rows) % EVERY == 1:
            report()
    found = report()
    if found["inadmissible"] or found["traces"] > 1:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
