"""Budgets of danger in place of thresholds: policies of step, state and what may still be spent.

Let U be any function that bounds threats, m_t = min_a U_t its least value and V_t = d + beta
E[m_{t+1}] its backup. For any m, the danger of an episode is D_0 = m_0 + E sum_t beta^t (V_t - m_t)
(`accounted`). So a policy that begins with the budget c - m_0, takes only actions whose excess U_t
- m_t is within it, and pays V_t - m_t (with refunds) or U_t - m_t (without) for each step keeps
D_0 at most c, plus by how much V exceeds U (docs/theory.md). Some action has no excess, so the set
is never empty, and no threshold x is chosen.

Excesses and costs of step t are multiplied by beta^t here: all is danger as seen from the start.
Budgets are whole numbers of levels of equal size. Costs are rounded up to whole levels, and refunds
and the first budget down, so that no budget is ever more than the exact one.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax import shield
from rp_jax.tabular import secure, thresholds
from rp_jax.tabular.cmdp import FiniteCMDP, array_of
from rp_jax.tabular.exact import Values, evaluate, expected, least_threat
from rp_jax.validate import number

LEVELS = 401  # default number of levels of a budget, 0 among them
MOST_LEVELS = 1_000_000


class Costs(NamedTuple):
    """Costs of actions by a function U, as seen from the start: multiplied by beta^t."""

    least: Array  # (H, S) m_t, not multiplied
    excess: Array  # (H, S, A) U - m, at least 0: what the budget must cover
    cost: Array  # (H, S, A) V - m, what a step is expected to cost; negative where U is loose
    error: Array  # (H, S, A) by how much V exceeds U; 0 if U is an upper function


def costs(cmdp: FiniteCMDP, upper: Array) -> Costs:
    """Returns what each action costs beyond the least danger.

    Args:
        cmdp: the CMDP, with a finite horizon.
        upper: (H, S, A) U: the threat of a policy, or anything else (`thresholds.certificate`).
    """
    least = upper.min(axis=-1)
    backed = thresholds.backup(cmdp, upper)
    weight = (cmdp.beta ** jnp.arange(len(upper)))[:, None, None]
    return Costs(
        least=least,
        excess=weight * (upper - least[..., None]),
        cost=weight * (backed - least[..., None]),
        error=weight * jnp.maximum(backed - upper, 0.0),
    )


def accounted(cmdp: FiniteCMDP, least: Array, policy: Array) -> Array:
    """Returns a policy's danger by the account of any function m, E[m_0 + sum beta^t (V_t - m_t)].

    It is the danger of an episode, `exact.expected(cmdp, exact.threat(cmdp, policy))`, whatever m.

    Args:
        cmdp: the CMDP.
        least: (H, S) m.
        policy: (S, A) or (H, S, A) probabilities.

    Returns:
        ().
    """
    spent = thresholds.backup(cmdp, least[..., None]) - least[..., None]
    total = evaluate(cmdp, spent, cmdp.beta, policy)
    return cmdp.start @ least[0] + expected(cmdp, total)


def budget_actions(excess: Array, budget: Array) -> Array:
    """Returns the actions that a budget allows, (A,) bool: those whose excess it covers.

    The least threatening action is allowed whatever the budget.

    Args:
        excess: (A,) U - m of the actions of a state.
        budget: () what may still be spent.
    """
    return shield.shield(excess, budget).admissible


def spend(budget: Array, cost: Array) -> Array:
    """Returns the budget after a step, never below 0.

    A cost beyond the budget is an overspend; it is forgiven, since with nothing left only the least
    threatening action is allowed, and a debt would forbid no more.

    Args:
        budget: () before the step.
        cost: () U - m or V - m of the action taken, or anything between.
    """
    return jnp.maximum(budget - cost, 0)


class BudgetRule(NamedTuple):
    """Excesses and costs in whole levels, for budgets of 0 to B - 1 levels."""

    excess: Array  # (H, S, A) int32, levels that an action needs
    cost: Array  # (H, S, A) int32, levels that it is charged; negative: refunded
    levels: Array  # (B,) int32, 0 to B - 1
    start: Array  # () int32, level at which an episode begins
    size: Array  # () danger of a level


def in_levels(danger: Array, size: Array, most: int) -> Array:
    """Returns dangers in whole levels, rounded up, int32: the least n with n * size >= danger.

    Args:
        danger: dangers, of any shape.
        size: () danger of a level.
        most: results are at most this and at least its negative.
    """
    count = jnp.clip(jnp.ceil(danger / size), -most, most)
    # The quotient is rounded, and may be on the other side of a whole number.
    count = jnp.where((count - 1) * size >= danger, count - 1, count)
    count = jnp.where(count * size < danger, count + 1, count)
    return jnp.clip(count, -most, most).astype(jnp.int32)


def budget_rule(
    cmdp: FiniteCMDP, upper: Array, c: Array | float, *, refund: bool, levels: int = LEVELS
) -> BudgetRule:
    """Returns the budget rule of a function U and a bound c, without checks, for jit and vmap.

    Refunds can raise a budget to c at most; what is beyond is forgone.

    Args:
        cmdp: the CMDP, with a finite horizon.
        upper: (H, S, A) U.
        c: () danger promised for an episode, at least E[m_0].
        refund: whether a step is charged V - m, which counts what U overstates as unspent; else
            U - m.
        levels: number of levels B of a budget.
    """
    found = costs(cmdp, upper)
    budget = jnp.maximum(c - cmdp.start @ found.least[0], 0.0)
    top = c if refund else budget
    size = jnp.where(top > 0, top, 1.0) / (levels - 1)
    return BudgetRule(
        excess=in_levels(found.excess, size, levels),
        cost=in_levels(found.cost if refund else found.excess, size, levels),
        levels=jnp.arange(levels, dtype=jnp.int32),
        start=-in_levels(-budget, size, levels - 1),
        size=size,
    )


def left(budget: Array, cost: Array, rule: BudgetRule) -> Array:
    """Returns the level of a budget after a step, at most the greatest, int32.

    Args:
        budget: level before the step.
        cost: of the action taken, in levels.
        rule: the rule, of which only the levels are used.
    """
    return jnp.minimum(spend(budget, cost), rule.levels[-1]).astype(jnp.int32)


def allowed(excess: Array, rule: BudgetRule) -> Array:
    """Returns the actions that each budget allows at a step, (S, B, A) bool, nowhere empty.

    Args:
        excess: (S, A) of the step, in levels.
        rule: the rule, of which only the levels are used.
    """
    of_budgets = jax.vmap(budget_actions, in_axes=(None, 0))
    return jax.vmap(of_budgets, in_axes=(0, None))(excess, rule.levels)


def after(cost: Array, rule: BudgetRule) -> Array:
    """Returns the level of each budget after each action of a step, (S, B, A) int32.

    Args:
        cost: (S, A) of the step, in levels.
        rule: the rule, of which only the levels are used.
    """
    return left(rule.levels[None, :, None], cost[:, None, :], rule)


def solve(
    cmdp: FiniteCMDP,
    rule: BudgetRule,
    signal: Array,
    discount: Array,
    choose: Callable[[Array, Any], Array],
    data: Any = None,
) -> Values:
    """Computes values of a policy of step, state and budget, chosen from these values.

    As `exact.solve`, by backward induction, with the budget as part of the state.

    Args:
        cmdp: the CMDP, with a finite horizon.
        rule: the rule.
        signal: (S, A) reward or danger of a step.
        discount: () discount of the signal.
        choose: maps values (S, B, A) and this step's data to a policy (S, B, A).
        data: pytree of (H, ...) arrays; by default the actions allowed, (S, B, A) bool.

    Returns:
        Values with shapes (H, S, B, A) and (H, S, B).
    """

    def back(ahead: Array, now: tuple[Array, Array, Any]) -> tuple[Array, Values]:
        excess, cost, given = now
        moved = jnp.einsum("saz,zb->sba", cmdp.transition, ahead)
        moved = jnp.take_along_axis(moved, after(cost, rule), axis=1)
        action = signal[:, None, :] + discount * moved
        policy = choose(action, allowed(excess, rule) if given is None else given)
        state = jnp.sum(policy * action, axis=-1)
        return state, Values(action, state, policy)

    last = jnp.zeros((cmdp.shape[1], len(rule.levels)), signal.dtype)
    return jax.lax.scan(back, last, (rule.excess, rule.cost, data), reverse=True)[1]


_most = jax.vmap(secure.most)  # over states; over budgets inside


def plan(cmdp: FiniteCMDP, rule: BudgetRule) -> Values:
    """Returns the best policy that keeps to its budget, with its values, (H, S, B, ...).

    Args:
        cmdp: the CMDP, with a finite horizon.
        rule: the rule.
    """
    return solve(cmdp, rule, cmdp.reward, cmdp.gamma, _most)


def worst(cmdp: FiniteCMDP, rule: BudgetRule) -> Values:
    """Returns the threats of the most dangerous policy that keeps to its budget, (H, S, B, ...).

    Args:
        cmdp: the CMDP, with a finite horizon.
        rule: the rule.
    """
    return solve(cmdp, rule, cmdp.danger, cmdp.beta, _most)


def threat(cmdp: FiniteCMDP, rule: BudgetRule, policy: Array) -> Values:
    """Returns the threats of a policy of step, state and budget, (H, S, B, ...).

    Args:
        cmdp: the CMDP, with a finite horizon.
        rule: the rule.
        policy: (H, S, B, A) probabilities.
    """
    return solve(cmdp, rule, cmdp.danger, cmdp.beta, lambda _, given: given, policy)


def at_start(cmdp: FiniteCMDP, rule: BudgetRule, values: Values) -> Array:
    """Returns the expected value of an episode, ().

    Args:
        cmdp: the CMDP.
        rule: the rule, which has the first budget.
        values: from `plan` for the return of an episode, from `threat` for its danger.
    """
    return cmdp.start @ values.state[0, :, rule.start]


def plan_with_budget(
    cmdp: FiniteCMDP, c: float, upper: Any, *, refund: bool = True, levels: int = LEVELS
) -> tuple[BudgetRule, Values]:
    """Returns the best policy that carries a budget of danger c, by dynamic programming.

    Args:
        cmdp: the CMDP, with a finite horizon.
        c: danger promised for an episode.
        upper: (H, S, A) U >= 0, such as `exact.threat(cmdp, policy).action`; where it is below its
            backup, the danger can exceed c by that.
        refund: whether a step is charged V - m; else U - m.
        levels: number of levels of a budget; more of them lose less by rounding.

    Returns:
        The rule in levels, and the policy with its values.

    Raises:
        ValueError: an argument is out of range; or c is below the least danger, by U or of any
            policy.
    """
    number("levels", levels, least=2, most=MOST_LEVELS, integer=True)
    check_promise(cmdp, c)
    given = array_of("upper", upper)
    if given.shape != cmdp.shape:
        raise ValueError(f"upper has shape {given.shape}; it must be {cmdp.shape}")
    if given.min() < 0:
        raise ValueError(f"upper has the value {given.min()}; it must be at least 0")
    bound = jnp.asarray(given)
    least = float(cmdp.start @ bound.min(axis=-1)[0])
    if least > c:
        raise ValueError(
            f"c is {c:g}; it must be at least {least:g}, the danger that upper leaves at the start "
            "whatever is done"
        )
    rule = budget_rule(cmdp, bound, c, refund=refund, levels=levels)
    return rule, plan(cmdp, rule)


def check_promise(cmdp: FiniteCMDP, c: float) -> None:
    """Raises ValueError unless some policy of a finite horizon keeps the danger at most c.

    Args:
        cmdp: the CMDP.
        c: danger promised for an episode.

    Raises:
        ValueError: c is negative or not finite, or less than any policy's danger; or the horizon is
            infinite.
    """
    number("c", c, least=0)
    if cmdp.horizon is None:
        raise ValueError(
            "horizon is None; it must be a number of steps, for budgets depend on them"
        )
    least = float(expected(cmdp, least_threat(cmdp)))
    if least > c:
        raise ValueError(
            f"c is {c:g}; it must be at least {least:g}, the least danger of any policy"
        )
