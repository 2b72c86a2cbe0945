"""The best that a CMDP allows: a linear program over occupancies, and the Lagrangian curve.

Host code in float64: scipy's HiGHS, and jitted backward induction.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy import optimize, sparse

from rp_jax.tabular.cmdp import FiniteCMDP
from rp_jax.tabular.secure import most
from rp_jax.tabular.threat import Values, expected, returns, solve, threat
from rp_jax.validate import number

TOLERANCE = 1e-9  # of HiGHS, primal and dual
ROUNDING = 1e-9  # what a vertex must lie above a chord, relative to the values' scale
MOST = 10_000  # vertices


class Optimum(NamedTuple):
    """The solution of equation 2."""

    value: float  # E[sum gamma^t r]
    danger: float  # E[sum beta^t d]
    policy: np.ndarray  # (H, S, A), uniform where it never comes
    occupancy: np.ndarray  # (H, S, A) P(s_t, a_t); for the infinite horizon sum_t gamma^t of it


def optimum(cmdp: FiniteCMDP, c: float) -> Optimum:
    """Equation 2 by a linear program over unnormalised occupancies, time-indexed if finite.

    Raises:
        ValueError: no policy keeps the danger at most c; or the horizon is infinite and the
            discounts differ, where stationary policies are not enough.
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
    # The interior point method, with crossover, is the fastest on long horizons, and solves some
    # that the simplex method gives up after presolving.
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
    """(H, S, A) probabilities of actions, uniform where the state is never met."""
    total = occupancy.sum(axis=-1, keepdims=True)
    met = total > TOLERANCE
    return np.where(met, occupancy / np.where(met, total, 1.0), 1 / occupancy.shape[-1])


def _same_discounts(cmdp: FiniteCMDP) -> None:
    gamma, beta = float(cmdp.gamma), float(cmdp.beta)
    if cmdp.horizon is None and gamma != beta:
        raise ValueError(
            f"beta is {beta:g}; it must be gamma, {gamma:g}, for the infinite horizon: else no "
            "stationary policy need be optimal"
        )


class Vertex(NamedTuple):
    """A deterministic policy on the concave hull of (danger, return)."""

    danger: float
    value: float
    policy: Array  # (H, S, A)


@jax.jit
def lagrangian(cmdp: FiniteCMDP, toll: Array, prize: Array) -> Values:
    """The policy of the greatest prize * return - toll * danger, and its values.

    gamma and beta may differ: step t weighs prize gamma^t r - toll beta^t d, undiscounted.
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
    """() danger and () return of a policy."""
    return expected(cmdp, threat(cmdp, policy)), expected(cmdp, returns(cmdp, policy))


def frontier(cmdp: FiniteCMDP, upto: float = np.inf) -> list[Vertex]:
    """The whole Lagrangian curve: the vertices of the concave hull, by rising danger.

    Between neighbours, a coin tossed before the episode reaches every point of the line, and no
    policy lies above it. All multipliers are covered: the chord of two known vertices is itself
    a multiplier, and either finds a vertex above it or proves that there is none.

    Args:
        cmdp: the CMDP.
        upto: only chords that begin before this danger are divided.

    Raises:
        ValueError: the horizon is infinite and the discounts differ.
        RuntimeError: there are more than `MOST` vertices.
    """
    _same_discounts(cmdp)

    def vertex(toll: float, prize: float) -> Vertex:
        policy = lagrangian(cmdp, jnp.asarray(toll), jnp.asarray(prize)).policy
        danger, value = _point(cmdp, policy)
        return Vertex(float(danger), float(value), policy)

    # The ends: least danger first, or greatest return first. The other aim, at a weight that
    # cannot matter but among equals, is the chord's business.
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
    """By rising danger, without what lies on or below a line between others, or falls.

    Of vertices whose dangers differ by no more than rounding, only the best.
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
    rise = (right.value - left.value) * (middle.danger - left.danger)
    return (middle.value - left.value) * (right.danger - left.danger) <= rise


def mixed(vertices: list[Vertex], c: float) -> float:
    """The greatest return at danger c, policies mixed by a coin; nan below the least danger."""
    dangers = np.asarray([v.danger for v in vertices])
    if c < dangers[0] - TOLERANCE * max(1.0, dangers[0]):
        return float("nan")
    return float(np.interp(c, dangers, [v.value for v in vertices]))


def unmixed(vertices: list[Vertex], c: float) -> Vertex | None:
    """The best vertex of danger at most c: what one Lagrange multiplier can reach."""
    within = [v for v in vertices if v.danger <= c + TOLERANCE * max(1.0, c)]
    return within[-1] if within else None
