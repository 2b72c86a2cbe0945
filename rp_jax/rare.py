"""Unbiased estimates of very small crash probabilities by multilevel splitting.

Before every crash of a shielded agent the least threat of any action grows. An episode in which it
reaches a level is split there: it is continued several times, and the rates of getting from one
level to the next are multiplied. The number of paths per level is fixed (Garvels 2000, section 2;
L'Ecuyer, Demers and Tuffin 2007, section 3.1); the mean of the product is the crash probability for
any choice of levels made beforehand.
"""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rp_jax.evaluation import shielded
from rp_jax.planning.percept import Percept, non_finite
from rp_jax.planning.pmdp import PMDP
from rp_jax.rollout import Step, rollout

Values = Callable[[Percept], Array]  # maps a batch of percepts to scores (B, A) of the actions
SHARE = 0.2  # share of the paths that should reach each level from the one before
MOST_LEVELS = 12


class Paths(NamedTuple):
    """A batch of episodes under way, leading axis (B,)."""

    states: Any  # the environment's current states
    starts: Any  # the states in which the episodes began
    highest: Array  # (B,) greatest value so far of the least threat of any action
    crashed: Array  # (B,) bool; a crash ends the path, even if the episode would continue
    reached: Array  # (B,) bool, the level of the last stage was reached, or the episode crashed
    length: Array  # (B,) int32, steps simulated in the last stage
    bad: Array  # (B,) bool, an observation or a threat was nan or infinite on the way


@functools.partial(jax.jit, static_argnames="count")
def begin(key: Array, pmdp: PMDP, count: int) -> Paths:
    """Starts new episodes.

    Args:
        key: random key for the starts.
        pmdp: the environment, the threats and the threshold.
        count: number of episodes.

    Returns:
        Paths with leading axis (count,).
    """
    states = jax.vmap(pmdp.env.reset, (0, None))(jax.random.split(key, count), pmdp.params)
    return from_starts(states, pmdp)


def from_starts(states: Any, pmdp: PMDP) -> Paths:
    """Returns paths that begin in given states.

    Args:
        states: states of the environment, leading axis (B,).
        pmdp: the environment, the threats and the threshold.
    """
    count = states.time.shape[0]
    no = jnp.zeros(count, bool)
    zero = jnp.zeros(count)
    return Paths(states, states, zero, no, no, jnp.zeros(count, jnp.int32), no)


def advance(key: Array, paths: Paths, pmdp: PMDP, values: Values, level: Array) -> Paths:
    """Continues each path until its least threat reaches a level, it crashes, or it ends.

    Args:
        key: random key for the environment's transitions.
        paths: the paths, leading axis (B,).
        pmdp: the environment, the threats and the threshold.
        values: scores the actions; the best admissible one is taken.
        level: () level of the least threat of any action; infinity continues until a crash.

    Returns:
        The paths where they stopped.
    """
    none = jnp.zeros(paths.highest.shape, jnp.int32)
    blank = paths._replace(reached=paths.crashed, length=none)

    def there(_: Array, percept: Percept) -> Array:
        return jnp.min(percept.threat, axis=-1) >= level

    def fold(paths: Paths, step: Step) -> Paths:
        least = jnp.where(step.alive, jnp.min(step.percept.threat, axis=-1), 0.0)
        crashed = step.moved & (step.outcome.danger > 0)
        bad_observation, bad_threat = non_finite(step.percept.encoded, step.percept.threat)
        return paths._replace(
            highest=jnp.maximum(paths.highest, least),
            crashed=paths.crashed | crashed,
            reached=paths.reached | (step.alive & ~step.moved) | crashed,
            length=paths.length + step.moved,
            bad=paths.bad | (step.moved & (bad_observation | bad_threat)),
        )

    states, found = rollout(
        key,
        pmdp,
        shielded(values),
        paths.states,
        fold,
        blank,
        alive=~paths.crashed,
        stop=there,
        over=lambda outcome: outcome.done | (outcome.danger > 0),
    )
    return found._replace(states=states)


def resample(key: Array, paths: Paths) -> Paths:
    """Returns as many paths again, each a copy of a random one that reached the level.

    Args:
        key: random key for the choice.
        paths: the paths after a stage, leading axis (B,); at least one must have reached the level.
    """
    odds = paths.reached / jnp.maximum(jnp.sum(paths.reached), 1)
    count = paths.highest.shape[0]
    chosen = jax.random.choice(key, count, (count,), p=odds)
    return jax.tree.map(lambda a: a[chosen], paths)


def risks(key: Array, states: Any, actions: Array, pmdp: PMDP, values: Values, tries: int) -> Array:
    """Returns how likely a crash is after each of several actions.

    Args:
        key: random key for the environment's transitions.
        states: states of the environment, leading axis (n,), in none of which the episode has
            ended.
        actions: (n, a) int, the actions to try in each state.
        pmdp: the environment, the threats and the threshold.
        values: scores the actions of the policy that follows the first action; the best admissible
            one is taken.
        tries: number of episodes for each state and action.

    Returns:
        (n, a) shares of these episodes that crash.
    """
    first, onward = jax.random.split(key)

    def step(key: Array, state: Any, action: Array) -> Any:
        return pmdp.env.step(key, state, action, pmdp.params)

    move = jax.vmap(jax.vmap(jax.vmap(step, (0, None, None)), (0, None, 0)), (0, 0, 0))
    keys = jax.random.split(first, (*actions.shape, tries))
    after = move(keys, states, actions)
    reached, outcome = jax.tree.map(lambda a: a.reshape(-1, *a.shape[3:]), after)
    crashed = outcome.danger > 0
    over = crashed | outcome.done
    paths = from_starts(reached, pmdp)._replace(crashed=over)  # marked paths stay where they are
    found = advance(onward, paths, pmdp, values, jnp.asarray(jnp.inf)).crashed
    return jnp.mean(jnp.where(over, crashed, found).reshape(*actions.shape, tries), axis=-1)


class Splitting(NamedTuple):
    """The result of one run of the estimator."""

    estimate: float  # probability that an episode crashes
    rates: list[float]  # rates of reaching each level from the one before; the last, of a crash
    steps: int  # number of simulated steps
    starts: Any  # (k, ...) starts of the paths that crashed, copies included; None without any


def splitting(
    key: Array,
    pmdp: PMDP,
    values: Values,
    levels: Sequence[float],
    particles: int,
    stage: Callable[..., Paths] | None = None,
) -> Splitting:
    """Estimates the probability that an episode crashes.

    Args:
        key: random key for the whole estimate.
        pmdp: the environment, the threats and the threshold.
        values: scores the actions; the best admissible one is taken.
        levels: ascending levels of the least threat of any action, chosen without using numbers of
            this run (see `choose_levels`).
        particles: number of paths in each stage.
        stage: `advance`, compiled for these values by `compiled`; compiled anew by default.

    Raises:
        ValueError: the levels do not ascend.
        FloatingPointError: an observation or a threat is not a finite number.
    """
    if any(b <= a for a, b in itertools.pairwise(levels)):
        raise ValueError(f"levels is {list(levels)}; they must ascend")
    stage = stage or compiled(values)
    start_key, key = jax.random.split(key)
    paths = begin(start_key, pmdp, particles)
    rates, steps = [], 0
    for i, level in enumerate([*levels, np.inf]):
        play, pick = jax.random.split(jax.random.fold_in(key, i))
        paths = stage(play, paths, pmdp, level)
        steps += int(paths.length.sum())
        rates.append(float(paths.reached.mean()))
        if rates[-1] == 0:
            return Splitting(0.0, rates, steps, None)
        if level < np.inf:
            paths = _resample(pick, paths)
    crashed = np.asarray(paths.crashed)
    starts = jax.tree.map(lambda a: np.asarray(a)[crashed], paths.starts)
    return Splitting(float(np.prod(rates)), rates, steps, starts)


_resample = jax.jit(resample)


def compiled(values: Values) -> Callable[..., Paths]:
    """Returns `advance`, compiled once for a policy.

    Args:
        values: scores the actions; the best admissible one is taken.

    Returns:
        A function (key, paths, pmdp, level) -> paths. It raises FloatingPointError if an
        observation or a threat of a path is not a finite number.
    """
    stage = jax.jit(lambda key, paths, pmdp, level: advance(key, paths, pmdp, values, level))

    def checked(key: Array, paths: Paths, pmdp: PMDP, level: float) -> Paths:
        found = stage(key, paths, pmdp, jnp.asarray(level, float))
        if count := int(found.bad.sum()):
            raise FloatingPointError(
                f"rare: observations or threats of {count:,} paths are nan or infinite"
            )
        return found

    return checked


def choose_levels(
    key: Array,
    pmdp: PMDP,
    particles: int,
    stage: Callable[..., Paths],
) -> tuple[list[float], int]:
    """Finds levels so that about a fifth of the paths gets from each to the next, by a pilot run.

    Use them with another key: an estimate is biased if its levels come from its own paths.

    Args:
        key: random key for the pilot run.
        pmdp: the environment, the threats and the threshold.
        particles: number of paths in each stage.
        stage: `advance`, compiled for a policy by `compiled`.

    Returns:
        The ascending levels, and the number of simulated steps.
    """
    levels: list[float] = []
    steps = 0
    start_key, key = jax.random.split(key)
    paths = begin(start_key, pmdp, particles)
    for i in range(MOST_LEVELS):
        look, play, pick = jax.random.split(jax.random.fold_in(key, i), 3)
        seen = stage(look, paths, pmdp, np.inf)
        steps += int(seen.length.sum())
        highest = np.where(np.asarray(seen.crashed), np.inf, np.asarray(seen.highest))
        level = float(np.quantile(highest, 1 - SHARE, method="lower"))
        if not (levels[-1] if levels else 0.0) < level < np.inf:
            break
        levels.append(level)
        paths = stage(play, paths, pmdp, level)
        steps += int(paths.length.sum())
        if not bool(paths.reached.any()):
            break
        paths = _resample(pick, paths)
    return levels, steps
