"""Thresholds x under which every policy inside the secure sets keeps the danger at most c.

The bound c is one of the discounted danger of an episode, E[sum_t beta^t d(s_t, a_t)] (equation 2).
A policy is called safe if it keeps it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.shield import Shield
from rp_jax.tabular import secure as sets
from rp_jax.tabular.cmdp import FiniteCMDP
from rp_jax.tabular.exact import Values, check_policy, expected, greedy, solve, threat
from rp_jax.validate import number

PAPER, TIGHT = 2.0, 1.0  # factors of Theorems 1 and 2: as printed, and the least that is true


def effective_horizon(beta: Array | float, horizon: int | None) -> Array:
    """Returns the sum of beta^k over the steps k, accurate however close beta is to 1.

    It is (1 - beta^T) / (1 - beta); T at beta = 1; and 1 / (1 - beta) for the infinite horizon.

    Args:
        beta: discount of danger, in [0, 1].
        horizon: number of steps T, or None for the infinite horizon.

    Returns:
        ().
    """
    beta = jnp.asarray(beta, float)
    left = 1 - beta
    if horizon is None:
        return 1 / left
    inside = jnp.where((left > 0) & (left < 1), left, 0.5)
    total = -jnp.expm1(horizon * jnp.log1p(-inside)) / inside
    ends = jnp.where(left > 0, 1.0, horizon)  # beta = 0, and beta = 1
    return jnp.where((left > 0) & (left < 1), total, ends)


def corollary_1(cmdp: FiniteCMDP, policy: Array, c: Array | float, factor: float = TIGHT) -> Array:
    """Returns the x of Corollary 1, for which policies in Pi_G^{eta,x} are safe (equation 6).

    Args:
        cmdp: the CMDP.
        policy: (S, A) or (H, S, A), the baseline policy eta.
        c: bound of the danger of an episode.
        factor: 2 as in the paper, or 1, which is enough (docs/theory.md).

    Returns:
        (); negative if eta itself is not safe.
    """
    left = c - expected(cmdp, threat(cmdp, policy))
    return left / (factor * effective_horizon(cmdp.beta, cmdp.horizon))


def corollary_2(cmdp: FiniteCMDP, policy: Array, c: Array | float, factor: float = TIGHT) -> Array:
    """Returns the x of Corollary 2, for which policies in Pi^{eta,x} are safe (equation 8).

    Args:
        cmdp: the CMDP.
        policy: (S, A) or (H, S, A), the baseline policy eta.
        c: bound of the danger of an episode.
        factor: 2 as in the paper, or 1, which is enough (docs/theory.md).

    Returns:
        (); negative if greedy-eta is not safe.
    """
    return corollary_1(cmdp, greedy(threat(cmdp, policy).action), c, factor)


class DangerBound(NamedTuple):
    """The bound of danger that any function U of threats guarantees (docs/theory.md)."""

    least: Array  # (H, S) least values m_t = min_a U_t
    excess: Array  # (H, S, A) e_t >= 0, by how much U violates U_t >= d + beta E[m_{t+1}]
    state: Array  # (H, S) bound of D_t for every policy inside the secure sets of U at x


def certificate(cmdp: FiniteCMDP, upper: Array, x: Array | float) -> DangerBound:
    """Returns the bound of the danger of all policies inside the secure sets of a function U.

    The bound is D_t <= m_t + sum_k beta^{k-t} E[1_S (x_k - m_k) + e_k], at the policy for which the
    right-hand side is greatest; 1_S is 1 in secure states.

    Args:
        cmdp: the CMDP.
        upper: (H, S, A) U >= 0: the threat of a policy, a sum of sub-threats, a learned model with
            a margin, or anything else.
        x: () or (H,) thresholds.
    """
    least, excess = _excess(cmdp, upper)
    allowed = sets.secure(upper, x)
    room = jnp.broadcast_to(x, least.shape[:1])[:, None] - least
    toll = jnp.where(allowed.secure, room, 0.0)[..., None] + excess
    spent = solve(cmdp, toll, cmdp.beta, sets.most, allowed.admissible)
    return DangerBound(least, excess, least + spent.state)


def backup(cmdp: FiniteCMDP, upper: Array) -> Array:
    """Returns the Bellman backup d + beta E[m_{t+1}] of a function U, where m is its least value.

    If the excess of U is e, then that of any mixture of U and min(U, backup) is at most e.

    Args:
        cmdp: the CMDP.
        upper: (H, S, A) U.

    Returns:
        (H, S, A).
    """
    least = upper.min(axis=-1)
    ahead = least if cmdp.horizon is None else jnp.append(least[1:], 0 * least[:1], axis=0)
    return cmdp.danger[None] + cmdp.beta * jnp.einsum("saz,hz->hsa", cmdp.transition, ahead)


def _excess(cmdp: FiniteCMDP, upper: Array) -> tuple[Array, Array]:
    """Returns the least values m (H, S) and the excess e (H, S, A) of U."""
    return upper.min(axis=-1), jnp.maximum(backup(cmdp, upper) - upper, 0.0)


def certified(cmdp: FiniteCMDP, upper: Array, c: Array | float) -> Array:
    """Returns the x that the certificate allows, whatever the policy inside the sets does.

    It is (c - E[m_0]) / sum_k beta^k - max e. For U = T^eta that is Corollary 2 with E[m_0] in
    place of the danger of greedy-eta.

    Args:
        cmdp: the CMDP.
        upper: (H, S, A) U, as for `certificate`.
        c: bound of the danger of an episode.

    Returns:
        (); negative if there is no threshold.
    """
    least, excess = _excess(cmdp, upper)
    return (c - cmdp.start @ least[0]) / effective_horizon(cmdp.beta, cmdp.horizon) - excess.max()


def evaluated(cmdp: FiniteCMDP, upper: Array, c: Array | float) -> Array:
    """Returns the largest useful x whose most dangerous admissible policy keeps E[D_0] <= c.

    The sets of each step grow only where x equals a value of `upper`, and the greatest danger never
    falls as they grow. So bisection over the sorted values finds x exactly. (The intersections of
    equation 5 are not nested, and bisection would fail.)

    Args:
        cmdp: the CMDP.
        upper: (H, S, A) threats; or threats less those of the state, for which x is the y of
            `secure_by_advantage`.
        c: bound of the danger of an episode.

    Returns:
        (); minus infinity (greedy-eta everywhere) if no value is small enough; nan if greedy-eta
        itself is not safe.
    """
    values = jnp.sort(upper.ravel())

    def safe(x: Array) -> Array:
        return expected(cmdp, sets.worst(cmdp, sets.secure(upper, x).admissible)) <= c

    def halve(bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds  # values[low - 1] is safe (or low is 0), values[high] is not (or n)
        middle = (low + high) // 2
        good = safe(values[middle])
        return jnp.where(good, middle + 1, low), jnp.where(good, high, middle)

    count, _ = jax.lax.while_loop(
        lambda b: b[0] < b[1], halve, (jnp.asarray(0), jnp.asarray(values.size))
    )
    none = jnp.where(safe(jnp.asarray(-jnp.inf)), -jnp.inf, jnp.nan)
    return jnp.where(count > 0, values[jnp.maximum(count - 1, 0)], none)


class Rule(NamedTuple):
    """The threshold and the admissible sets that a rule chooses for a bound c."""

    x: Array  # () the threshold x, or y of `secure_by_advantage`
    shield: Shield  # the admissible sets


def paper(cmdp: FiniteCMDP, policy: Array, c: Array | float) -> Rule:
    """Applies Corollary 2 as printed, with the sets of equation 5.

    Args:
        cmdp: the CMDP.
        policy: (S, A) or (H, S, A), the baseline policy eta.
        c: bound of the danger of an episode.
    """
    x = corollary_2(cmdp, policy, c, PAPER)
    return Rule(x, sets.secure_at_all_times(threat(cmdp, policy).action, x))


def tight(cmdp: FiniteCMDP, policy: Array, c: Array | float) -> Rule:
    """Applies Corollary 2 with factor 1, with the sets of equation 5.

    Args:
        cmdp: the CMDP.
        policy: (S, A) or (H, S, A), the baseline policy eta.
        c: bound of the danger of an episode.
    """
    x = corollary_2(cmdp, policy, c)
    return Rule(x, sets.secure_at_all_times(threat(cmdp, policy).action, x))


def per_step(cmdp: FiniteCMDP, policy: Array, c: Array | float) -> Rule:
    """Applies Corollary 2 with factor 1, with the sets of each step.

    Args:
        cmdp: the CMDP.
        policy: (S, A) or (H, S, A), the baseline policy eta.
        c: bound of the danger of an episode.
    """
    x = corollary_2(cmdp, policy, c)
    return Rule(x, sets.secure(threat(cmdp, policy).action, x))


def by_evaluation(cmdp: FiniteCMDP, policy: Array, c: Array | float) -> Rule:
    """Finds the largest x that the most dangerous policy allows, with the sets of each step.

    Args:
        cmdp: the CMDP.
        policy: (S, A) or (H, S, A), the baseline policy eta.
        c: bound of the danger of an episode.
    """
    action = threat(cmdp, policy).action
    x = evaluated(cmdp, action, c)
    return Rule(x, sets.secure(action, x))


def by_advantage(cmdp: FiniteCMDP, policy: Array, c: Array | float) -> Rule:
    """Finds the largest y for which the sets T - D <= y are safe, with these sets.

    Args:
        cmdp: the CMDP.
        policy: (S, A) or (H, S, A), the baseline policy eta.
        c: bound of the danger of an episode.
    """
    values = threat(cmdp, policy)
    advantage = values.action - values.state[..., None]
    y = evaluated(cmdp, advantage, c)
    return Rule(y, sets.secure_by_advantage(values, y))


RULES = {
    "paper": paper,
    "tight": tight,
    "per step": per_step,
    "evaluated": by_evaluation,
    "advantage": by_advantage,
}


def reconnoitre_and_plan(
    cmdp: FiniteCMDP,
    c: float,
    policy: Array,
    rule: Callable[[FiniteCMDP, Array, Array | float], Rule] = paper,
) -> tuple[Rule, Values]:
    """Computes Algorithm 1: the secure sets of a baseline policy, and the best policy inside them.

    Args:
        cmdp: the CMDP.
        c: bound of the danger of an episode.
        policy: (S, A) or (H, S, A), the baseline policy eta; `least_threat(cmdp).policy` is eta*.
        rule: one of `RULES`.

    Returns:
        The threshold and the sets that the rule chooses, and the best policy with its values.

    Raises:
        ValueError: c or the policy is out of range; or there is no threshold, since not even
            greedy-eta keeps the danger at most c.
    """
    number("c", c, least=0)
    policy = check_policy(cmdp, policy)
    least = expected(cmdp, threat(cmdp, greedy(threat(cmdp, policy).action)))
    if least > c:
        raise ValueError(
            f"c is {c:g}; it must be at least {float(least):g}, the danger of greedy-eta: the "
            "baseline policy is not safe"
        )
    return planned(cmdp, c, policy, rule)


def planned(
    cmdp: FiniteCMDP,
    c: Array | float,
    policy: Array,
    rule: Callable[[FiniteCMDP, Array, Array | float], Rule] = paper,
) -> tuple[Rule, Values]:
    """Computes Algorithm 1 without checks, for jit and vmap; see `reconnoitre_and_plan`.

    Where the baseline policy is not safe (x negative or nan), the result keeps no bound.

    Args:
        cmdp: the CMDP.
        c: bound of the danger of an episode.
        policy: (S, A) or (H, S, A), the baseline policy eta.
        rule: one of `RULES`.

    Returns:
        The threshold and the sets that the rule chooses, and the best policy with its values.
    """
    chosen = rule(cmdp, policy, c)
    return chosen, sets.plan(cmdp, chosen.shield.admissible)
