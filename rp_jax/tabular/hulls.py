"""The exact optimum by budgets that are split among outcomes: a promise for each of them.

A promise p is the danger that may follow from a step on: the least danger m_t(s) and a budget. The
agent promises p' to each next state, with d + beta E[p'] = p, where `rp_jax.tabular.budgets` leaves
the same budget for all of them. What can be earned under a promise, V_t(s, p), is concave in p,
because promises can be mixed: its graph is the upper hull of the points (danger, return) that
policies reach. Hulls are polygons. That of an action is the sum of the hulls of its next states
(their edges, the steepest first), that of a state the hull of those of its actions. So backward
induction is exact, and its optimum that of the linear program (`rp_jax.tabular.oracle`).

This is host code in float64.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rp_jax.tabular.budgets import check_promise
from rp_jax.tabular.cmdp import FiniteCMDP

ROUNDING = 1e-12  # dangers and returns that differ by no more, relative to the largest, are equal


class Hull(NamedTuple):
    """The greatest return under each promise of danger: corners by rising danger and return."""

    danger: np.ndarray  # (n,)
    value: np.ndarray  # (n,) return
    action: np.ndarray  # (n,) int, the action by which each corner is reached

    def best(self, promise: float) -> float:
        """Returns the greatest return under a promise; beyond the last corner nothing is gained.

        Args:
            promise: danger, at least that of the first corner.
        """
        return float(np.interp(promise, self.danger, self.value))


class PromisedAction(NamedTuple):
    """One of the actions that are mixed, with what it promises."""

    probability: float  # of this action
    action: int
    promises: np.ndarray  # (S,) danger promised for each next state


class Hulls(NamedTuple):
    """Hulls of all steps and states."""

    cmdp: FiniteCMDP
    steps: list[list[Hull]]  # of step t and state s, [t][s]; the last, t = T, are points at 0

    def choices(self, t: int, state: int, promise: float) -> list[PromisedAction]:
        """Returns the action to take under a promise, or the two to mix, with what they promise.

        Args:
            t: the step.
            state: the state.
            promise: danger that may follow, at least the least danger of the state.
        """
        hull = self.steps[t][state]
        promise = float(np.clip(promise, hull.danger[0], hull.danger[-1]))
        right = min(int(np.searchsorted(hull.danger, promise)), len(hull.danger) - 1)
        left = max(right - 1, 0)
        if promise == hull.danger[right] or hull.action[left] == hull.action[right]:
            return [self._choice(t, state, int(hull.action[right]), 1.0, promise)]
        share = (promise - hull.danger[left]) / (hull.danger[right] - hull.danger[left])
        return [
            self._choice(t, state, int(hull.action[i]), probability, float(hull.danger[i]))
            for i, probability in ((left, 1 - share), (right, share))
        ]

    def _choice(
        self, t: int, state: int, action: int, probability: float, promise: float
    ) -> PromisedAction:
        """Returns a choice whose action splits a promise among its next states."""
        chances = float(self.cmdp.beta) * np.asarray(self.cmdp.transition[state, action])
        left = promise - float(self.cmdp.danger[state, action])
        return PromisedAction(probability, action, split(self.steps[t + 1], chances, left))

    def at_start(self, promise: float) -> np.ndarray:
        """Returns the danger promised to each first state, (S,), of a promise for the episode.

        Args:
            promise: danger of an episode.
        """
        return split(self.steps[0], np.asarray(self.cmdp.start), promise)

    def best(self, promise: float) -> float:
        """Returns the greatest expected return of an episode under a promise of danger.

        Args:
            promise: danger of an episode.
        """
        start = np.asarray(self.cmdp.start)
        each = zip(start, self.steps[0], self.at_start(promise), strict=True)
        return sum(float(chance) * hull.best(part) for chance, hull, part in each if chance > 0)


def hulls(cmdp: FiniteCMDP, c: float) -> Hulls:
    """Returns the greatest return of every step, state and promise of danger, by exact induction.

    Args:
        cmdp: the CMDP, with a finite horizon.
        c: danger promised for an episode; `Hulls.best` gives the optimum.

    Raises:
        ValueError: c is negative or not finite, or less than any policy's danger; or the horizon is
            infinite.
    """
    check_promise(cmdp, c)
    kernel, reward, danger = map(np.asarray, (cmdp.transition, cmdp.reward, cmdp.danger))
    gamma, beta = float(cmdp.gamma), float(cmdp.beta)
    horizon, states, actions = cmdp.shape
    nothing = Hull(np.zeros(1), np.zeros(1), np.zeros(1, int))
    step = np.stack([danger, reward])[..., None]  # (2, S, A, 1)
    steps = [[nothing] * states]
    for _ in range(horizon):
        sums = [
            [step[:, s, a] + _sum(steps[-1], kernel[s, a], beta, gamma) for a in range(actions)]
            for s in range(states)
        ]
        steps.append([_union(each) for each in sums])
    return Hulls(cmdp, steps[::-1])


def split(hulls: Sequence[Hull], chances: np.ndarray, promise: float) -> np.ndarray:
    """Returns the promises to several states that earn the most, of a promise for their mean.

    Each state is promised its least danger. What is left goes where it earns the most.

    Args:
        hulls: of the S states.
        chances: (S,) weights of the states' dangers in the mean; where a weight is 0, a promise
            costs nothing, and is the greatest that is of use.
        promise: the weighted sum of the promises; at least that of the least dangers.

    Returns:
        (S,) dangers, whose weighted sum is the promise, or less if more is of no use.
    """
    each = zip(hulls, chances, strict=True)
    promises = np.asarray([hull.danger[0 if weight > 0 else -1] for hull, weight in each])
    owner, harm, _ = _edges(hulls, chances)
    cost = chances[owner] * harm
    left = promise - chances @ promises - (np.cumsum(cost) - cost)
    np.add.at(promises, owner, np.clip(left / cost, 0.0, 1.0) * harm)
    return promises


def _edges(hulls: Sequence[Hull], chances: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the edges of the hulls of positive weight, the steepest first.

    They are the state that each belongs to, and its extent in danger and in return, (n,) each.
    """
    met = np.flatnonzero(chances > 0).tolist()
    owner = np.repeat(np.asarray(met, int), [len(hulls[i].danger) - 1 for i in met])
    if len(owner) == 0:
        return owner, np.zeros(0), np.zeros(0)
    harm = np.concatenate([np.diff(hulls[i].danger) for i in met])
    gain = np.concatenate([np.diff(hulls[i].value) for i in met])
    order = np.argsort(-gain / harm, kind="stable")
    return owner[order], harm[order], gain[order]


def _sum(ahead: Sequence[Hull], chances: np.ndarray, beta: float, gamma: float) -> np.ndarray:
    """Returns the corners (2, n) of danger and return that are expected of the next states."""
    harm_of, gain_of = beta * chances, gamma * chances
    owner, harm, gain = _edges(ahead, harm_of)
    corners = np.zeros((2, len(owner) + 1))
    for i in np.flatnonzero(chances > 0).tolist():
        first = 0 if harm_of[i] > 0 else -1  # danger that does not count costs nothing
        corners[:, 0] += harm_of[i] * ahead[i].danger[first], gain_of[i] * ahead[i].value[first]
    corners[:, 1:] = harm_of[owner] * harm, gain_of[owner] * gain
    return np.cumsum(corners, axis=1)


def _union(corners: Sequence[np.ndarray]) -> Hull:
    """Returns the upper hull of the actions' corners, each (2, n), as far as returns rise."""
    action = np.repeat(np.arange(len(corners)), [each.shape[1] for each in corners])
    danger, value = np.concatenate(corners, axis=1)
    order = np.lexsort((-value, danger))
    danger, value, action = danger[order], value[order], action[order]
    equal = ROUNDING * np.abs(danger).max()
    least = ROUNDING * np.abs(value).max()
    rising = np.append(True, value[1:] > np.maximum.accumulate(value)[:-1])
    kept = np.flatnonzero(rising)
    # Of corners of equal danger the best is kept, which is the last of them.
    kept = kept[np.append(np.diff(danger[kept]) > equal, True)]
    while True:
        d, v = danger[kept], value[kept]
        slope = (v[2:] - v[:-2]) / (d[2:] - d[:-2])
        height = v[1:-1] - v[:-2] - slope * (d[1:-1] - d[:-2])
        low = height <= 0  # below a line between two others: on no hull
        if not low.any():
            low = height <= least
            # No two neighbours at once, for their heights depend on each other.
            low[1::2] &= not low[::2].any()
        if not low.any():
            return Hull(d, v, action[kept])
        kept = np.delete(kept, np.flatnonzero(low) + 1)
