"""How often a policy crashes that hardly ever does: multilevel splitting, without bias.

Every crash of a shielded agent comes after states in which the least threat of any action grows.
Episodes that reach a level of it are split there: the way on is simulated more often, and the
rates from level to level are multiplied. Fixed effort; see Garvels (2000), section 2, and L'Ecuyer,
Demers, Tuffin (2007), section 3.1: the product's mean is the crash probability for any choice of
levels made beforehand.
"""

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rp_jax import shield
from rp_jax.envs.base import select
from rp_jax.planning.pmdp import PMDP, Percept, faults

Values = Callable[[Percept], Array]
SHARE = 0.2  # of the paths, that reach one level from the one before
MOST_LEVELS = 12


class Paths(NamedTuple):
    """Episodes under way, leading axis (B,)."""

    states: Any  # where they are
    starts: Any  # where they began
    highest: Array  # (B,) greatest least threat on the way so far
    crashed: Array  # (B,) bool; there the path ends, even if the episode would go on
    reached: Array  # (B,) bool, the level of the last stage was reached, or the episode crashed
    length: Array  # (B,) int32, steps simulated in the last stage
    bad: Array  # (B,) bool, an observation or a threat was nan or infinite on the way


@functools.partial(jax.jit, static_argnames="count")
def begin(key: Array, pmdp: PMDP, count: int) -> Paths:
    """Fresh episodes, (count,)."""
    states = jax.vmap(pmdp.env.reset, (0, None))(jax.random.split(key, count), pmdp.params)
    return from_starts(states, pmdp)


def from_starts(states: Any, pmdp: PMDP) -> Paths:
    """Episodes from given states, leading axis (B,)."""
    count = states.time.shape[0]
    no = jnp.zeros(count, bool)
    zero = jnp.zeros(count, pmdp.x.dtype)
    return Paths(states, states, zero, no, no, jnp.zeros(count, jnp.int32), no)


def advance(key: Array, paths: Paths, pmdp: PMDP, values: Values, level: Array) -> Paths:
    """Plays each path on until its least threat is at least `level`, it crashes, or it ends.

    Args:
        key: of the environment's randomness.
        paths: with leading axis (B,).
        pmdp: the environment, the threats and the threshold.
        values: scores the actions, as in `evaluate.run_episodes`.
        level: () of the least threat; infinity: until a crash.
    """
    count = paths.highest.shape[0]
    keys = jax.random.split(key, count)

    def step(carry):
        t, alive, paths = carry
        percept = pmdp.perceive(paths.states, alive)
        least = jnp.where(alive, jnp.min(percept.threat, axis=-1), 0.0)
        there = alive & (least >= level)
        alive = alive & ~there
        action = jax.vmap(shield.masked_argmax)(values(percept), percept.admissible)
        now = jax.vmap(jax.random.fold_in, (0, None))(keys, t)
        move = jax.vmap(pmdp.env.step, (0, 0, 0, None))
        states, outcome = move(now, paths.states, action, pmdp.params)
        bad_observation, bad_threat = faults(percept.encoded, percept.threat)
        crashed = alive & (outcome.danger > 0)
        paths = Paths(
            states=jax.vmap(select)(alive, states, paths.states),
            starts=paths.starts,
            highest=jnp.maximum(paths.highest, least),
            crashed=paths.crashed | crashed,
            reached=paths.reached | there | crashed,
            length=paths.length + alive,
            bad=paths.bad | (alive & (bad_observation | bad_threat)),
        )
        return t + 1, alive & ~outcome.done & ~crashed, paths

    blank = paths._replace(reached=paths.crashed, length=jnp.zeros(count, jnp.int32))
    carry = (jnp.asarray(0), ~paths.crashed, blank)
    return jax.lax.while_loop(lambda c: jnp.any(c[1]), step, carry)[2]


def resample(key: Array, paths: Paths) -> Paths:
    """As many paths, each a copy of one of those that reached the level; at least one must."""
    odds = paths.reached / jnp.maximum(jnp.sum(paths.reached), 1)
    count = paths.highest.shape[0]
    chosen = jax.random.choice(key, count, (count,), p=odds)
    return jax.tree.map(lambda a: a[chosen], paths)


def risks(key: Array, states: Any, actions: Array, pmdp: PMDP, values: Values, tries: int) -> Array:
    """(n, a) share of `tries` episodes that crash which go on by an action, then by the policy.

    Args:
        key: of the environment's randomness.
        states: leading axis (n,), of which no episode has ended.
        actions: (n, a) int, tried in each of the states.
        pmdp: the environment, the threats and the threshold.
        values: scores the actions of the policy, as in `evaluate.run_episodes`.
        tries: episodes for each state and action.
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
    paths = from_starts(reached, pmdp)._replace(crashed=over)  # those stay where they are
    found = advance(onward, paths, pmdp, values, jnp.asarray(jnp.inf, pmdp.x.dtype)).crashed
    return jnp.mean(jnp.where(over, crashed, found).reshape(*actions.shape, tries), axis=-1)


class Splitting(NamedTuple):
    """One run of the estimator."""

    estimate: float  # probability that an episode crashes
    rates: list[float]  # of reaching each level from the one before, and last a crash
    steps: int  # simulated
    starts: Any  # (k, ...) where episodes began that crashed, copies included; None without any


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
        key: of everything random in it.
        pmdp: the environment, the threats and the threshold.
        values: scores the actions.
        levels: of the least threat, ascending, chosen without looking at this run's numbers.
        particles: paths per stage.
        stage: `advance`, compiled for `values` (see `compiled`).

    Raises:
        ValueError: the levels do not ascend.
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
    """(key, paths, pmdp, level) -> Paths: `advance`, compiled once for a policy.

    It raises FloatingPointError if a path saw what is not a finite number.
    """
    stage = jax.jit(lambda key, paths, pmdp, level: advance(key, paths, pmdp, values, level))

    def checked(key: Array, paths: Paths, pmdp: PMDP, level: float) -> Paths:
        found = stage(key, paths, pmdp, jnp.asarray(level, pmdp.x.dtype))
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
    """Levels that about a fifth of the paths reach from one to the next, found by a pilot run.

    Use them with other keys: an estimate whose levels come from its own paths is biased.

    Returns:
        (levels, steps simulated).
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
