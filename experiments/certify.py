"""Shows, or fails to show, that an agent's crash rate is at most c.

How many episodes it takes, and how many crashes are allowed, is settled before any is played.

python -m experiments.certify --run results/RUN --c 1e-3 --confidence .99
"""

import functools
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

import rp_jax
from experiments import cli, console, runs, tasks
from experiments.evaluation import ROUND
from rp_jax import evaluate, statistics, storage
from rp_jax.validate import number


@dataclass(frozen=True, kw_only=True)
class Config(runs.Choice):
    """What is to be shown."""

    c: float  # crash rate not to be exceeded
    confidence: float = 0.99  # of the statement
    expected: float | None = None  # crash rate that shall pass with 90 %; default: c / 2
    out: Path | None = None  # JSON file for the statement

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        super().validate()
        number("c", self.c, above=0)
        number("confidence", self.confidence, above=0)


def run(config: Config) -> dict[str, Any]:
    """Plays until it is decided. Returns the statement as a row of facts."""
    config.validate()
    expected = config.c / 2 if config.expected is None else config.expected
    n, allowed = statistics.plan_test(config.c, config.confidence, expected, 0.9)
    loaded = runs.load(config.run)
    variant, pmdp, network, params = loaded.subject(config.variant, config.agent)
    console.say(
        f"plan: {n:,} episodes of {loaded.task.name} {variant}; {allowed} crashes or fewer show "
        f"a rate of at most {config.c:g} at {100 * config.confidence:g} % confidence"
    )

    @functools.partial(jax.jit, static_argnames="episodes")
    def play(key, params, pmdp, episodes):
        values = evaluate.action_values(network, params)
        return evaluate.run_episodes(key, pmdp, values, episodes, batch=episodes)

    key = tasks.key_of(config.seed, tasks.CERTIFICATE)
    size, began = min(ROUND, n), time.perf_counter()
    rounds = -(-n // size)
    done = crashes = 0
    with console.progress("certify") as bar:
        for i in range(rounds):
            found = play(jax.random.fold_in(key, i), params, pmdp, episodes=size)
            evaluate.check(found, "certify")
            danger = np.asarray(found.danger)[: n - done]
            done, crashes = done + len(danger), crashes + int((danger > 0).sum())
            bar("", i + 1, rounds, f"{crashes} crashes of {allowed} allowed")
            if crashes > allowed:
                break
    row = {
        "env": loaded.task.name,
        "variant": variant,
        "method": tasks.method_name(loaded.config),
        "sha256": loaded.sha256,
        "agent": config.agent,
        "c": config.c,
        "confidence": config.confidence,
        "planned_episodes": n,
        "allowed_crashes": allowed,
        "episodes": done,
        "crashes": crashes,
        "shown": crashes <= allowed,
        # After an early end the crashes are too many by choice: there is no bound to state.
        "upper_bound": statistics.upper_bound(crashes, done, config.confidence)
        if crashes <= allowed
        else None,
        "seed": config.seed,
        "version": rp_jax.__version__,
        "seconds": time.perf_counter() - began,
    }
    console.say(statement(row), style="green" if row["shown"] else "yellow")
    return row


def statement(row: dict[str, Any]) -> str:
    """The outcome in words."""
    what = f"{row['env']} {row['variant']}, {row['method']}, artefact {row['sha256'][:16]}"
    counts = f"{row['crashes']} crashes in {row['episodes']:,} episodes"
    level = f"{100 * row['confidence']:g} % confidence"
    if row["shown"]:
        return (
            f"SHOWN: {what}: crash rate at most {row['c']:g} per episode at {level} ({counts}; "
            f"bound {row['upper_bound']:.3g})"
        )
    return (
        f"NOT SHOWN: {what}: a crash rate of at most {row['c']:g} per episode at {level} "
        f"({counts}; {row['allowed_crashes']} in {row['planned_episodes']:,} were allowed)"
    )


def main() -> None:
    """Exits with 1 where nothing is shown, with 2 on bad input."""
    config = tyro.cli(Config, description=__doc__)
    with cli.bad_input():
        cli.needs_folder(config.out)
        row = run(config)
        if config.out is not None:
            storage.write_json(config.out, row)
    raise SystemExit(0 if row["shown"] else 1)


if __name__ == "__main__":
    main()
