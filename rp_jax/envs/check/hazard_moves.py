"""Whether the environment moves its hazards as their sources do."""

from typing import Any

import jax
import numpy as np

from rp_jax.envs.check.batches import flat, join, repeat, take
from rp_jax.envs.check.comparison import LARGE, LEVEL, told_apart, tolerance_of, unequal
from rp_jax.envs.check.pairs import Pairs
from rp_jax.envs.check.problems import number_of, value_of
from rp_jax.envs.check.trial import Trial

STATES = 8  # that are stepped with many keys
KEYS = 512
HAZARDS = 8  # of a kind in a state, at most
PLACES = 512  # static hazards that are looked for after a step


def moved_statics(trial: Trial) -> list[str]:
    """Returns which hazards move although their source says that they are static.

    Args:
        trial: the environment.
    """
    found = []
    for kind, pairs in trial.pairs.items():
        if pairs.static:
            found += _moved_by_source(trial, pairs) + _moved_by_step(trial, pairs, kind)
    return found


def _moved_by_source(trial: Trial, pairs: Pairs) -> list[str]:
    bodies, hazards = pairs.sample(256)
    visited = trial.visited(pairs.kind, 256)
    bodies, hazards = join(bodies, visited[0]), join(hazards, visited[1])
    count = len(jax.tree.leaves(hazards)[0])
    after = pairs.drift(trial.draws.keys(count), hazards, bodies)
    bad = unequal(after, hazards)
    if not bad.any():
        return []
    row = int(np.argmax(bad))
    return [
        f"step of the source of {pairs.kind!r} moves the hazard in "
        f"{number_of(int(bad.sum()), count, 'steps')}, from {value_of(take(hazards, row))} to "
        f"{value_of(take(after, row))}, although `static` is True; a static hazard must stay where "
        "it is"
    ]


def _moved_by_step(trial: Trial, pairs: Pairs, kind: str) -> list[str]:
    """Static hazards that are in reach after a step, and not hit, must be where they were."""
    rows = trial.draws.among(np.arange(len(trial.steps.action)), 256)
    before, reached = (take(tree, rows) for tree in (trial.steps.before, trial.steps.reached))
    was, now = (trial.find(trial.params, states)[kind] for states in (before, reached))
    where, which = np.nonzero(was.present)
    if not len(where):
        return []
    chosen = trial.draws.among(np.arange(len(where)), PLACES)
    where, which = where[chosen], which[chosen]
    hazards = jax.tree.map(lambda a: a[where, which], was.state)
    _, hit, reach = pairs.look(take(reached.body, where), hazards)
    expected = reach & ~hit
    where, old = where[expected], flat(hazards)[expected]
    if not len(where):
        return []
    shape = now.present.shape
    new = flat(jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), now.state)).reshape(*shape, -1)
    gaps = (
        np.abs(new[where] - old[:, None]).max(axis=-1) > 1e-4 * (1 + np.abs(old).max(-1))[:, None]
    )
    lost = (gaps | ~now.present[where]).all(axis=1)
    if lost.mean() <= LARGE:
        return []
    row = int(np.argmax(lost))
    return [
        f"step moves hazards of kind {kind!r}, or takes them away, in "
        f"{number_of(int(lost.sum()), len(lost), 'cases')}, such as that at {value_of(old[row])}, "
        "although their source says that they are static; hazards that are in reach and not hit "
        "must stay where they are"
    ]


def unlike_moves(trial: Trial) -> list[str]:
    """Returns which kinds of hazards `step` moves by another distribution than their source.

    Args:
        trial: the environment.
    """
    moving = [kind for kind, pairs in trial.pairs.items() if not pairs.static]
    if not moving:
        return []
    steps, draws = trial.steps, trial.draws
    some = draws.among(np.arange(len(steps.action)), 256)
    groups = trial.find_moving(trial.params, take(steps.before, some))
    there = sum(groups[kind].present.any(axis=1).astype(int) for kind in moving)
    rows = np.argsort(-there, kind="stable")[: max(1, trial.at_most(STATES * KEYS) // KEYS)]
    states = take(steps.before, some[rows])
    actions = draws.integers(len(rows), trial.num_actions)
    made = trial.advance(repeat(states, KEYS), np.repeat(actions, KEYS))
    after, found = trial.find_moving(trial.params, made.reached), []
    for kind in moving:
        was = take(groups[kind], rows)
        pairs, reached = trial.pairs[kind], made.reached.body
        found += _compared(trial, pairs, states.body, was, reached, after[kind])
    return found


def _compared(trial: Trial, pairs: Pairs, body: Any, was: Any, reached: Any, now: Any) -> list[str]:
    """Compares the hazards of one kind, of each state, with where its source takes them.

    Args:
        trial: the environment.
        pairs: the kind's functions.
        body: bodies before the steps, (states, ...).
        was: the hazards before them, (states, n, ...).
        reached: bodies after them, (states * KEYS, ...).
        now: the hazards after them, (states * KEYS, n, ...).
    """
    cases: list[tuple[int, int]] = []
    for row, present in enumerate(was.present):
        there = np.flatnonzero(present)
        few = trial.draws.among(there, min(HAZARDS, len(there))) if len(there) else there
        cases += [(row, int(i)) for i in few]
    tested, apart = 0, 0
    for row, which in cases:
        span = slice(row * KEYS, (row + 1) * KEYS)
        one = take(take(was.state, row), np.full(KEYS, which))
        same = take(body, np.full(KEYS, row))
        bodies, states, present = take(reached, span), take(now.state, span), now.present[span]
        if present[:, which].mean() < 0.9:
            continue  # the world has taken it away
        expected = pairs.features(bodies, pairs.drift(trial.draws.keys(KEYS), one, same))
        tolerance = tolerance_of(expected, bodies, loose=0.0)
        level = LEVEL / len(cases)
        got = pairs.features(bodies, jax.tree.map(lambda a, w=which: a[:, w], states))
        differ = told_apart(got[present[:, which]], expected, tolerance, level)
        if differ:  # unless hazards are listed in an order of their own
            got = _nearest(pairs, bodies, states, present, expected)
            differ = told_apart(got, expected, tolerance, level)
        tested, apart = tested + 1, apart + int(differ)
    if apart <= LARGE * tested:
        return []
    return [
        f"step moves hazards of kind {pairs.kind!r} otherwise than their source does in "
        f"{number_of(apart, tested, 'pairs of a state and a hazard')} (features of {KEYS} steps "
        f"each, compared by a Kolmogorov-Smirnov test); both must draw from the same distribution, "
        "though a world may make exceptions"
    ]


def _nearest(
    pairs: Pairs, bodies: Any, states: Any, present: np.ndarray, expected: np.ndarray
) -> np.ndarray:
    """Features (k, F) of the hazard of each step that is nearest to what is expected."""
    count, n = present.shape
    every = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), states)
    features = pairs.features(repeat(bodies, n), every).reshape(count, n, -1)
    gap = np.square(features - expected.mean(axis=0)).sum(axis=-1)
    choice = np.argmin(np.where(present, gap, np.inf), axis=1)
    return features[np.arange(count), choice]
