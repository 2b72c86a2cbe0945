"""Tree search in the true model (MPC) as a job: how it does, and how long it takes."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rp_jax import evaluation
from rp_jax.baselines import mpc
from rp_jax.baselines.mpc import Search
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.runs import record
from rp_jax.runs.evaluate import Timing, timed
from rp_jax.runs.progress import OnProgress, silent
from rp_jax.runs.tables import Table
from rp_jax.streams import Stream, key_of
from rp_jax.validate import number, path, random_key

GROUP = 50  # episodes between two reports of progress


def evaluate_search(
    key: Array,
    searches: Mapping[str, Search],
    *,
    episodes: int = 1000,
    penalty: float = 0.0,
    folder: str | Path | None = None,
    on_progress: OnProgress = silent,
) -> Table:
    """Plays episodes of tree search in each test, and says what it earned and how long it took.

    Args:
        key: of the episodes: the same for all tests.
        searches: by the name of a test, the model with its parameters and the settings; they may
            differ in their parameters alone.
        episodes: of each test.
        penalty: taken off the returns per unit of danger; that of the search is its own.
        folder: where checkpoints are kept meanwhile; the same call goes on after an interruption.
        on_progress: called with (stage, done, total, note).

    Returns:
        A row per test, as `evaluate` has them, with the seconds of 100 decisions: one after
        another, likewise of all cores, and among many episodes.

    Raises:
        ValueError: a setting is out of range.
        FloatingPointError: a reward is not a finite number.
    """
    random_key("key", key)
    number("episodes", episodes, least=1, integer=True)
    number("penalty", penalty, least=0)
    if not searches:
        raise ValueError("searches is {}; it must have at least one")
    first = next(iter(searches.values()))
    spec = {
        "env": record.name_of(first.model),
        "key": record.key_data(key),
        "horizon": {test: search.horizon for test, search in searches.items()},
        "searches": {test: _digest(search) for test, search in searches.items()},
        "episodes": episodes,
        **record.machine(first.model),
    }
    where, rows = None if folder is None else path("folder", folder), []
    with record.job(where, "MPC", spec) as checkpoints:
        for test, search in searches.items():
            own = key_of(key, Stream.SEARCH)
            at, stage = checkpoints.at(f"test {test}"), f"search {test}".strip()
            found, seconds = play_search(own, search, episodes, stage, on_progress, at)
            evaluation.check(found, stage)
            alone = time_search(key, search)
            rows.append(
                {
                    "env": record.short_name(search.model),
                    "variant": test,
                    "method": method_name(search),
                    "seed": 0,
                    **evaluation.summarise(found, penalty),
                    "seconds_per_100_actions": alone.wall,
                    "cpu_seconds_per_100_actions": alone.cpu,
                    "seconds_per_100_actions_in_batch": seconds,
                    "train_seconds": 0.0,
                }
            )
    return Table(rows)


def _digest(search: Search) -> str:
    """The checksum of a search's parameters and settings."""
    return record.digest_of((search.params, search.penalty, search.limit))


def method_name(search: Search) -> str:
    """Returns what a search is called in tables: MPC with its steps, and its limit if it has one.

    Args:
        search: the settings.
    """
    limit = "" if jnp.isinf(search.limit) else f", x={float(search.limit):g}"
    steps = "1 step" if search.horizon == 1 else f"{search.horizon} steps"
    return f"MPC ({steps}{limit})"


def play_search(
    key: Array,
    search: Search,
    episodes: int,
    stage: str = "search",
    on_progress: OnProgress = silent,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> tuple[evaluation.Episodes, float]:
    """Plays episodes of tree search, a group of them after another.

    Args:
        key: of the episodes.
        search: the model and the settings.
        episodes: how many.
        stage: named in the progress.
        on_progress: called with (stage, done, total, note).
        checkpoints: of the groups.

    Returns:
        Rows with leading axis (episodes,), and the seconds of 100 decisions among so many, without
        compilation.
    """
    pmdp, size = mpc.omniscient(search), min(GROUP, episodes)

    def group(key: Array, pmdp: mpc.Omniscient, search: Search) -> evaluation.Episodes:
        return evaluation.play_round(key, pmdp, evaluation.shielded(mpc.values(search)), size)

    on_progress(stage, 0, episodes, "compiling")
    run = jax.jit(group).lower(key, pmdp, search).compile()
    rounds = -(-episodes // size)
    shapes = jax.eval_shape(group, key, pmdp, search)
    rows = jax.tree.map(lambda s: np.zeros((rounds, *s.shape), s.dtype), shapes)

    def step(i: int, carried: tuple[Any, np.ndarray]) -> tuple[Any, np.ndarray]:
        (rows, seconds), began = carried, time.perf_counter()
        found = run(jax.random.fold_in(key, i), pmdp, search)
        for whole, new in zip(jax.tree.leaves(rows), jax.tree.leaves(found), strict=True):
            whole[i] = new
        seconds[i] = time.perf_counter() - began
        crashes, done = int((rows.danger > 0).sum()), min((i + 1) * size, episodes)
        on_progress(stage, done, episodes, f"{crashes} crashes in {(i + 1) * size}")
        return rows, seconds

    rows, seconds = checkpoints.loop((rows, np.zeros(rounds, np.float32)), step, rounds)
    rows = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), rows)
    each = 100 * float(seconds.sum()) / int(rows.length.sum())
    return jax.tree.map(lambda a: a[:episodes], rows), each


def time_search(key: Array, search: Search) -> Timing:
    """Returns how long 100 decisions take, one after another.

    Args:
        key: of the environment.
        search: the model and the settings.
    """
    decide = jax.jit(lambda state, search: jnp.argmax(mpc.pruned(state, search)))
    own, env = key_of(key, Stream.TIMING), search.model
    return timed(own, env, search.params, lambda state: decide(state, search))
