"""The best that a CMDP allows: a linear program over occupancies, and the Lagrangian curve.

This is host code in float64, with SciPy's HiGHS and jitted backward induction.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy import optimize, sparse

from rp_jax.tabular.cmdp import FiniteCMDP
from rp_jax.tabular.exact import Values, expected, returns, solve, threat
from rp_jax.tabular.secure import most
from rp_jax.validate import number

TOLERANCE = 1e-9  # primal and dual tolerance of HiGHS
ROUNDING = 1e-9  # height that a new vertex must have above a chord, relative to the values' scale
MOST = 10_000  # greatest number of vertices


class Optimum(NamedTuple):
    """The solution of a CMDP (equation 2)."""

    value: float  # expected return E[sum gamma^t r]
    danger: float  # expected danger E[sum beta^t d]
    policy: np.ndarray  # (H, S, A) probabilities; uniform in states that are never visited
    occupancy: np.ndarray  # (H, S, A) P(s_t, a_t); for the infinite horizon its sum with gamma^t


def optimum(cmdp: FiniteCMDP, c: float) -> Optimum:
    """Solves equation 2 by a linear program over occupancies.

    The occupancies are not normalised, and time-indexed if the horizon is finite.

    Args:
        cmdp: the CMDP.
        c: bound of the danger of an episode; infinity for none.

    Raises:
        ValueError: no policy keeps the danger at most c; or the horizon is infinite and the
            discounts differ, for which stationary policies are not enough.
        RuntimeError: the linear program could not be solved.
    """
    c = float(c) if np.ndim(c) == 0 and np.isrealobj(c) else c
    number("c", c, least=0, infinite=True)
    horizon, states, actions = cmdp.shape
    gamma, beta = float(cmdp.gamma), float(cmdp.beta)
    _same_discounts(cmdp)
    kernel = np.asarray(cmdp.transition, np.float64).reshape(states * actions, states)
    leave = sparse.kron(sparse.eye_array(states), np.ones((1, actions)), format="csr")
    arrive = sparse.csr_array(kernel.T)
    if cmdp.horizon is None:
        flow = leave - gamma * arrive
        weights = np.ones((2, 1))
    else:
        below = sparse.diags_array(np.ones(horizon - 1), offsets=-1, shape=(horizon,) * 2)
        flow = sparse.kron(sparse.eye_array(horizon), leave) - sparse.kron(below, arrive)
        weights = np.asarray([[gamma], [beta]]) ** np.arange(horizon)
    source = np.zeros(horizon * states)
    source[:states] = cmdp.start
    reward = np.outer(weights[0], np.asarray(cmdp.reward, np.float64).ravel()).ravel()
    danger = np.outer(weights[1], np.asarray(cmdp.danger, np.float64).ravel()).ravel()
    limited = np.isfinite(c)
    program = functools.partial(
        optimize.linprog,
        -reward,
        A_ub=danger[None] if limited else None,
        b_ub=[c] if limited else None,
        A_eq=flow.tocsr(),
        b_eq=source,
        options={
            "primal_feasibility_tolerance": TOLERANCE,
            "dual_feasibility_tolerance": TOLERANCE,
        },
    )
    # The interior point method with crossover is the fastest on long horizons, and solves some
    # problems that the simplex method gives up on.
    found = program(method="highs-ipm")
    if found.status not in (0, 2):
        found = program(method="highs-ds")
    if found.status == 2:
        raise ValueError(f"c is {c:g}; it must be at least the least danger of any policy")
    if found.status != 0:
        raise RuntimeError(f"the linear program was not solved: {found.message}")
    occupancy = np.maximum(found.x, 0.0).reshape(cmdp.shape)
    return Optimum(
        value=float(reward @ found.x),
        danger=float(danger @ found.x),
        policy=_policy_of(occupancy),
        occupancy=occupancy,
    )


def _policy_of(occupancy: np.ndarray) -> np.ndarray:
    """Returns the policy (H, S, A) of an occupancy, uniform in states that are never visited."""
    total = occupancy.sum(axis=-1, keepdims=True)
    met = total > TOLERANCE
    return np.where(met, occupancy / np.where(met, total, 1.0), 1 / occupancy.shape[-1])


def _same_discounts(cmdp: FiniteCMDP) -> None:
    """Raises ValueError if the horizon is infinite and the discounts differ."""
    gamma, beta = float(cmdp.gamma), float(cmdp.beta)
    if cmdp.horizon is None and gamma != beta:
        raise ValueError(
            f"beta is {beta:g}; it must be gamma, {gamma:g}, for the infinite horizon: else no "
            "stationary policy need be optimal"
        )


class Vertex(NamedTuple):
    """A deterministic policy on the concave hull of (danger, return)."""

    danger: float  # expected danger of an episode
    value: float  # expected return
    policy: Array  # (H, S, A) probabilities


@jax.jit
def lagrangian(cmdp: FiniteCMDP, toll: Array, prize: Array) -> Values:
    """Returns the policy that maximises prize * return - toll * danger, and its values.

    gamma and beta may differ: step t is weighted by prize gamma^t r - toll beta^t d, undiscounted.

    Args:
        cmdp: the CMDP.
        toll: () price of danger.
        prize: () weight of the return.
    """
    if cmdp.horizon is None:
        signal, discount = prize * cmdp.reward - toll * cmdp.danger, cmdp.gamma
    else:
        t = jnp.arange(cmdp.horizon)[:, None, None]
        gain, harm = cmdp.gamma**t * cmdp.reward[None], cmdp.beta**t * cmdp.danger[None]
        signal = prize * gain - toll * harm
        discount = jnp.ones(())
    allowed = jnp.ones(cmdp.shape, bool)
    return solve(cmdp, signal, discount, most, allowed)


@jax.jit
def _point(cmdp: FiniteCMDP, policy: Array) -> tuple[Array, Array]:
    """Returns the expected danger and the expected return of a policy, () each."""
    return expected(cmdp, threat(cmdp, policy)), expected(cmdp, returns(cmdp, policy))


def frontier(cmdp: FiniteCMDP, upto: float = np.inf) -> list[Vertex]:
    """Returns the whole Lagrangian curve: the vertices of the concave hull, by rising danger.

    Every point of the line between two neighbours is reached by a coin toss before the episode, and
    no policy lies above the curve. All multipliers are covered: the chord of two known vertices is
    itself a multiplier, and its policy either lies above the chord or proves that none does.

    Args:
        cmdp: the CMDP.
        upto: only chords that begin below this danger are divided further.

    Raises:
        ValueError: the horizon is infinite and the discounts differ.
        RuntimeError: there are more than `MOST` vertices.
    """
    _same_discounts(cmdp)

    def vertex(toll: float, prize: float) -> Vertex:
        policy = lagrangian(cmdp, jnp.asarray(toll), jnp.asarray(prize)).policy
        danger, value = _point(cmdp, policy)
        return Vertex(float(danger), float(value), policy)

    # The ends of the curve: one with the least danger, one with the greatest return. Among equals
    # either may be suboptimal in the other respect; the chords then find the better vertices.
    low, high = vertex(1.0, 0.0), vertex(0.0, 1.0)
    scale = max(1e-300, abs(low.value), abs(high.value), high.danger)
    found, open_chords = [low, high], [(low, high)]
    while open_chords:
        if len(found) > MOST:
            raise RuntimeError(f"the Lagrangian curve has more than {MOST} vertices")
        left, right = open_chords.pop()
        toll, prize = right.value - left.value, right.danger - left.danger
        if prize <= ROUNDING * scale or toll <= 0 or left.danger > upto:
            continue
        size = np.hypot(toll, prize)
        between = vertex(toll / size, prize / size)
        gain = prize * (between.value - left.value) - toll * (between.danger - left.danger)
        if gain / size > ROUNDING * scale:
            found.append(between)
            open_chords += [(left, between), (between, right)]
    return _hull(found, ROUNDING * scale)


def _hull(vertices: list[Vertex], rounding: float) -> list[Vertex]:
    """Returns the vertices of the concave hull, by rising danger and rising return.

    Of vertices whose dangers differ by no more than `rounding`, only the best is kept.
    """
    chain: list[Vertex] = []
    for vertex in sorted(vertices, key=lambda v: (v.danger, -v.value)):
        if chain and vertex.value <= chain[-1].value:
            continue
        if chain and vertex.danger <= chain[-1].danger + rounding:
            chain.pop()
        while len(chain) > 1 and _below(chain[-2], chain[-1], vertex):
            chain.pop()
        chain.append(vertex)
    return chain


def _below(left: Vertex, middle: Vertex, right: Vertex) -> bool:
    """Returns whether a vertex lies on or below the line between two others."""
    rise = (right.value - left.value) * (middle.danger - left.danger)
    return (middle.value - left.value) * (right.danger - left.danger) <= rise


def mixed(vertices: list[Vertex], c: float) -> float:
    """Returns the greatest return at a given danger, by policies mixed by a coin toss.

    Args:
        vertices: the Lagrangian curve, from `frontier`.
        c: bound of the danger of an episode.

    Returns:
        The return; nan if c is below the least danger.
    """
    dangers = np.asarray([v.danger for v in vertices])
    if c < dangers[0] - TOLERANCE * max(1.0, dangers[0]):
        return float("nan")
    return float(np.interp(c, dangers, [v.value for v in vertices]))


def unmixed(vertices: list[Vertex], c: float) -> Vertex | None:
    """Returns the best vertex of danger at most c: what a single Lagrange multiplier can reach.

    Args:
        vertices: the Lagrangian curve, from `frontier`.
        c: bound of the danger of an episode.

    Returns:
        The vertex; None if c is below the least danger.
    """
    within = [v for v in vertices if v.danger <= c + TOLERANCE * max(1.0, c)]
    return within[-1] if within else None
