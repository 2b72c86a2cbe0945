"""Thresholds x under which every policy inside the secure sets keeps the danger at most c.

`c` bounds the discounted danger of an episode, E[sum_t beta^t d(s_t, a_t)] (equation 2).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.shield import Shield
from rp_jax.tabular import secure as sets
from rp_jax.tabular.cmdp import FiniteCMDP
from rp_jax.tabular.threat import Values, check_policy, expected, greedy, solve, threat
from rp_jax.validate import number

PAPER, TIGHT = 2.0, 1.0  # factors of Theorems 1 and 2: as printed, and as true


def effective_horizon(beta: Array | float, horizon: int | None) -> Array:
    """() sum of beta^k over the steps k, accurate however close beta is to 1.

    (1 - beta^T) / (1 - beta); T at beta = 1; 1 / (1 - beta) for the infinite horizon.
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
    """() x of Corollary 1: policies in Pi_G^{eta,x} are safe (equation 6).

    Negative if eta itself is not safe.

    Args:
        cmdp: the CMDP.
        policy: eta.
        c: bound on the danger of an episode.
        factor: 2 as the paper has it, or 1, which is enough (docs/theory.md).
    """
    left = c - expected(cmdp, threat(cmdp, policy))
    return left / (factor * effective_horizon(cmdp.beta, cmdp.horizon))


def corollary_2(cmdp: FiniteCMDP, policy: Array, c: Array | float, factor: float = TIGHT) -> Array:
    """() x of Corollary 2: policies in Pi^{eta,x} are safe (equation 8).

    Arguments as for `corollary_1`; it is greedy-eta that must be safe here.
    """
    return corollary_1(cmdp, greedy(threat(cmdp, policy).action), c, factor)


class Certificate(NamedTuple):
    """What any function U above the threat guarantees (docs/theory.md, the certificate)."""

    least: Array  # (H, S) m_t = min_a U_t
    excess: Array  # (H, S, A) e_t, by which U fails U_t >= d + beta E[m_{t+1}]
    state: Array  # (H, S) bound on D_t of every policy inside the secure sets of U at x


def certificate(cmdp: FiniteCMDP, upper: Array, x: Array | float) -> Certificate:
    """D_t <= m_t + sum_k beta^{k-t} E[1_S (x_k - m_k) + e_k], at its worst policy.

    Args:
        cmdp: the CMDP.
        upper: (H, S, A) U >= 0: the threat of a policy, a sum of sub-threats, a learned
            model and a margin, or anything else.
        x: () or (H,) thresholds.
    """
    least, excess = _excess(cmdp, upper)
    allowed = sets.secure(upper, x)
    room = jnp.broadcast_to(x, least.shape[:1])[:, None] - least
    toll = jnp.where(allowed.secure, room, 0.0)[..., None] + excess
    spent = solve(cmdp, toll, cmdp.beta, sets.most, allowed.admissible)
    return Certificate(least, excess, least + spent.state)


def backup(cmdp: FiniteCMDP, upper: Array) -> Array:
    """(H, S, A) d + beta E[m_{t+1}], one step of value iteration on U's least actions.

    If U's excess is e, that of any mixture of U and the lesser of both is at most e.
    """
    least = upper.min(axis=-1)
    ahead = least if cmdp.horizon is None else jnp.append(least[1:], 0 * least[:1], axis=0)
    return cmdp.danger[None] + cmdp.beta * jnp.einsum("saz,hz->hsa", cmdp.transition, ahead)


def _excess(cmdp: FiniteCMDP, upper: Array) -> tuple[Array, Array]:
    """(H, S) m and (H, S, A) e."""
    return upper.min(axis=-1), jnp.maximum(backup(cmdp, upper) - upper, 0.0)


def certified(cmdp: FiniteCMDP, upper: Array, c: Array | float) -> Array:
    """() x that the certificate allows whatever the policy and wherever it goes.

    (c - E[m_0]) / sum_k beta^k - max e: for U = T^eta it is Corollary 2 with E[m_0] in place of
    D^{greedy-eta}. Negative if there is none.
    """
    least, excess = _excess(cmdp, upper)
    return (c - cmdp.start @ least[0]) / effective_horizon(cmdp.beta, cmdp.horizon) - excess.max()


def evaluated(cmdp: FiniteCMDP, upper: Array, c: Array | float) -> Array:
    """() the largest x of use whose WORST admissible policy keeps E[D_0] <= c.

    The sets of each step grow only at x equal to a value of `upper`, and the worst danger never
    falls as they grow; so it is a bisection over the sorted values, exact. (The intersections of
    equation 5 are not nested, and would not do.) Minus infinity (greedy-eta
    everywhere) if no value will do; nan if greedy-eta itself is not safe.

    Args:
        cmdp: the CMDP.
        upper: (H, S, A) threats, or threats less the state's (then x is the y of
            `secure_by_advantage`).
        c: bound on the danger of an episode.
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
    """A way to the admissible sets for a bound c."""

    x: Array  # () the threshold, or y
    shield: Shield


def paper(cmdp: FiniteCMDP, policy: Array, c: Array | float) -> Rule:
    """Corollary 2 as printed, with the sets of equation 5."""
    x = corollary_2(cmdp, policy, c, PAPER)
    return Rule(x, sets.secure_at_all_times(threat(cmdp, policy).action, x))


def tight(cmdp: FiniteCMDP, policy: Array, c: Array | float) -> Rule:
    """Corollary 2 with factor 1, with the sets of equation 5."""
    x = corollary_2(cmdp, policy, c)
    return Rule(x, sets.secure_at_all_times(threat(cmdp, policy).action, x))


def per_step(cmdp: FiniteCMDP, policy: Array, c: Array | float) -> Rule:
    """Corollary 2 with factor 1, and each step's own sets."""
    x = corollary_2(cmdp, policy, c)
    return Rule(x, sets.secure(threat(cmdp, policy).action, x))


def by_evaluation(cmdp: FiniteCMDP, policy: Array, c: Array | float) -> Rule:
    """The largest x that the worst policy allows, and each step's own sets."""
    action = threat(cmdp, policy).action
    x = evaluated(cmdp, action, c)
    return Rule(x, sets.secure(action, x))


def by_advantage(cmdp: FiniteCMDP, policy: Array, c: Array | float) -> Rule:
    """The largest y with T - D <= y that the worst policy allows."""
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
    """Algorithm 1: the secure sets of a baseline policy, and the best policy inside them.

    Args:
        cmdp: the CMDP.
        c: bound on the danger of an episode.
        policy: eta; `least_threat(cmdp).policy` is eta*.
        rule: one of RULES.

    Raises:
        ValueError: c or the policy is out of range, or the baseline policy is not safe: not even
            greedy-eta keeps the danger at most c, so that there is no threshold.
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
    """`reconnoitre_and_plan` without its checks, for jit and vmap.

    Where the baseline policy is not safe (x negative or nan), the plan keeps no bound.
    """
    chosen = rule(cmdp, policy, c)
    return chosen, sets.plan(cmdp, chosen.shield.admissible)
