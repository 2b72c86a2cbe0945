"""Rare crashes as a job: how often an agent crashes, and the starts that it crashes from most."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rp_jax import rare, statistics, storage
from rp_jax.envs import optional
from rp_jax.planning.pmdp import PMDP
from rp_jax.runs.agents import Agent
from rp_jax.runs.progress import OnProgress, silent
from rp_jax.validate import number, one_of

STARTS = "start states"  # the kind of file that worst starts are saved as
MOST_STARTS = 100_000
SIDE_BY_SIDE = 20_000  # episodes from given starts


@dataclass(frozen=True)
class RareConfig:
    """Sizes of an estimate of rare crashes, and of the search for the worst starts."""

    particles: int = 1000  # paths a stage of splitting
    repeats: int = 20  # independent estimates, for the interval
    generations: int = 10  # of the search for the worst starts; 0: no search
    population: int = 200  # starts a generation
    tries: int = 50  # episodes from each start
    kept: int = 20  # worst starts that are kept
    checks: int = 2000  # fresh episodes from each of those

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        number("particles", self.particles, least=10, integer=True)
        number("repeats", self.repeats, least=2, integer=True)
        number("generations", self.generations, least=0, integer=True)
        number("population", self.population, least=10, integer=True)
        number("tries", self.tries, least=1, integer=True)
        number("kept", self.kept, least=1, most=min(self.population, MOST_STARTS), integer=True)
        number("checks", self.checks, least=1, integer=True)


class Subject(NamedTuple):
    """The agent under test, compiled."""

    pmdp: PMDP
    values: rare.Values
    stage: Any  # `rare.advance`, compiled


def subject_of(agent: Agent) -> Subject:
    """Returns an agent with a compiled program that plays its episodes on.

    Args:
        agent: in the world that it is tested in.
    """
    return Subject(agent.pmdp, agent.values, rare.compiled(agent.values))


def estimate(
    key: Array, subject: Subject, config: RareConfig, on_progress: OnProgress = silent
) -> tuple[dict[str, Any], Any]:
    """Estimates an agent's crash rate by splitting, and by plain episodes of as many steps.

    Args:
        key: of everything random in it.
        subject: the agent.
        config: sizes.
        on_progress: called with (stage, done, total, note).

    Returns:
        A row of facts, and the starts (n, ...) that led to crashes, copies included; None where
        none did.
    """
    pilot, key, plain_key = jax.random.split(key, 3)
    pmdp, values, stage = subject
    began = time.perf_counter()
    levels, steps = rare.choose_levels(pilot, pmdp, config.particles, stage)
    found = []
    for i in range(config.repeats):
        on_progress("splitting", i, config.repeats, f"{len(levels)} levels")
        own = jax.random.fold_in(key, i)
        found.append(rare.splitting(own, pmdp, values, levels, config.particles, stage=stage))
    on_progress("splitting", config.repeats, config.repeats, "")
    steps += sum(run.steps for run in found)
    mean, width = statistics.mean_interval(np.asarray([run.estimate for run in found]))
    took = time.perf_counter() - began
    whole = [run.rates for run in found if len(run.rates) == len(levels) + 1]
    row = {
        "levels": levels,
        "rates": np.mean(whole, axis=0) if whole else [],
        "estimate": mean,
        # The spread of repeats without a crash says nothing.
        "ci95": [max(0.0, mean - width), mean + width] if mean > 0 else None,
        "repeats": config.repeats,
        "steps": steps,
        "seconds": took,
        "plain": _plain(plain_key, subject, config.particles, steps, on_progress),
    }
    starts = [run.starts for run in found if run.starts is not None]
    return row, jax.tree.map(lambda *a: np.concatenate(a), *starts) if starts else None


def _plain(
    key: Array, subject: Subject, count: int, steps: int, on_progress: OnProgress
) -> dict[str, Any]:
    """Crashes of plain episodes, `count` at a time, of at least so many steps."""
    n = k = played = 0
    while played < steps:
        start, play = jax.random.split(jax.random.fold_in(key, n))
        begun = rare.begin(start, subject.pmdp, count)
        paths = subject.stage(play, begun, subject.pmdp, np.inf)
        n, k = n + count, k + int(paths.crashed.sum())
        played += int(paths.length.sum())
        on_progress("plain episodes", min(played, steps), steps, f"{k} crashes of {n:,}")
    interval = list(statistics.clopper_pearson(k, n))
    return {"episodes": n, "crashes": k, "rate": k / n, "ci95": interval, "steps": played}


def crashes_from(key: Array, subject: Subject, starts: Any, tries: int) -> np.ndarray:
    """Counts crashes in episodes from given starts.

    Args:
        key: of the environment's randomness.
        subject: the agent.
        starts: leading axis (n,).
        tries: episodes from each.

    Returns:
        (n,) int, crashes.
    """
    count = starts.time.shape[0]
    block = max(1, min(tries, SIDE_BY_SIDE // count))
    total = np.zeros(count, int)
    many = jax.tree.map(lambda a: jnp.repeat(jnp.asarray(a), block, axis=0), starts)
    for i, done in enumerate(range(0, tries, block)):
        paths = rare.from_starts(many, subject.pmdp)
        own = jax.random.fold_in(key, i)
        crashed = subject.stage(own, paths, subject.pmdp, np.inf).crashed
        total += np.asarray(crashed).reshape(count, block)[:, : tries - done].sum(axis=1)
    return total


def distinct(starts: Any) -> Any:
    """Returns each of some starts once, in the order of their first appearance.

    Args:
        starts: leading axis (n,).
    """
    rows = [np.asarray(a) for a in jax.tree.leaves(starts)]
    flat = [np.ascontiguousarray(a.reshape(len(a), -1)).view(np.uint8) for a in rows]
    _, first = np.unique(np.concatenate(flat, axis=1), axis=0, return_index=True)
    kept = np.sort(first)
    return jax.tree.map(lambda a: a[kept], starts)


def worst_starts(
    key: Array,
    subject: Subject,
    first: Any,
    config: RareConfig,
    on_progress: OnProgress = silent,
) -> Any:
    """Searches for starts of most crashes: the worst tenth of each generation has offspring.

    Args:
        key: of the search.
        subject: the agent.
        first: starts that have led to crashes, (n, ...), copies included; or None. Half of the
            first generation is of them.
        config: sizes.
        on_progress: called with (stage, done, total, note).

    Returns:
        At most `config.kept` different starts.
    """
    pmdp, size = subject.pmdp, config.population
    elite = max(config.kept, size // 10)
    draw = jax.jit(
        lambda key: jax.vmap(pmdp.env.reset, (0, None))(jax.random.split(key, size), pmdp.params)
    )
    breed = jax.jit(jax.vmap(lambda *parts: optional.mixed_start(pmdp.env, *parts)))
    first_key, mix, key = jax.random.split(key, 3)
    starts = draw(first_key)
    if first is not None:
        known = distinct(first)
        picked = np.asarray(jax.random.permutation(mix, known.time.shape[0])[: size // 2])
        rest = size - len(picked)
        starts = jax.tree.map(lambda a, b: jnp.concatenate([a[picked], b[:rest]]), known, starts)
    best = starts
    for i in range(config.generations):
        play, parent_key, fresh_key, mix_key = jax.random.split(jax.random.fold_in(key, i), 4)
        starts = distinct(starts)
        crashes = crashes_from(play, subject, starts, config.tries)
        order = np.argsort(-crashes, kind="stable")[:elite]
        note = f"the worst {elite} crash in {100 * crashes[order].mean() / config.tries:.1f} %"
        on_progress("worst starts", i + 1, config.generations, note)
        best = jax.tree.map(lambda a, order=order: a[order], starts)
        chosen = jax.random.randint(parent_key, (size,), 0, len(order))
        parents = jax.tree.map(lambda a, chosen=chosen: a[chosen], best)
        children = breed(jax.random.split(mix_key, size), parents, draw(fresh_key))
        more = size - len(order)
        children = jax.tree.map(lambda a, more=more: a[:more], children)
        starts = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), best, children)
    return jax.tree.map(lambda a: a[: config.kept], best)


def checked_starts(
    key: Array, subject: Subject, starts: Any, episodes: int
) -> list[dict[str, Any]]:
    """Counts crashes in fresh episodes from each of some starts.

    Args:
        key: of the environment's randomness.
        subject: the agent.
        starts: leading axis (n,).
        episodes: from each.

    Returns:
        (n,) rows with crashes, episodes and an exact interval.
    """
    found = crashes_from(key, subject, starts, episodes)
    interval = statistics.clopper_pearson
    return [
        {"crashes": int(k), "episodes": episodes, "ci95": list(interval(int(k), episodes))}
        for k in found
    ]


def save_starts(folder: Path, starts: Any, about: dict[str, Any]) -> None:
    """Saves start states.

    Args:
        folder: created if missing.
        starts: leading axis (n,).
        about: "env" and "variant", which `load_starts` asks for again.

    Raises:
        storage.StorageError: they cannot be written.
    """
    storage.save(folder, STARTS, starts, {**about, "count": starts.time.shape[0]})


def load_starts(folder: Path, pmdp: PMDP, about: dict[str, Any]) -> Any:
    """Loads start states that an earlier search has kept, (n, ...).

    Args:
        folder: given to `save_starts`.
        pmdp: whose states they are.
        about: "env" and "variant".

    Raises:
        ValueError: they are missing, damaged, or of another world or test.
    """
    found = storage.read_manifest(folder, STARTS)["about"]
    for name in ("env", "variant"):
        one_of(f"{folder}: {name}", str(found.get(name)), [about[name]])
    number(f"{folder}: count", found.get("count"), least=1, most=MOST_STARTS, integer=True)
    one = jax.eval_shape(pmdp.env.reset, jax.random.key(0), pmdp.params)
    like = jax.tree.map(lambda a: jax.ShapeDtypeStruct((found["count"], *a.shape), a.dtype), one)
    return storage.load(folder, STARTS, like, convert=True)
