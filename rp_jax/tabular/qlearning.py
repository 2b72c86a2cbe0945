"""Algorithm 4 on a finite CMDP: Q-learning inside the secure sets, or within a budget of danger.

Actions are chosen by `rp_jax.shield`, as in the deep learner.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax import shield
from rp_jax.tabular import budgets
from rp_jax.tabular.budgets import BudgetRule
from rp_jax.tabular.cmdp import FiniteCMDP
from rp_jax.validate import number


class LearnerState(NamedTuple):
    """The learner's state between two steps."""

    values: Array  # (H, S, A) the values Q; with budgets (H, S, B, A)
    visits: Array  # of the same shape, int32, how often each value was updated


def init(cmdp: FiniteCMDP, rule: BudgetRule | None = None) -> LearnerState:
    """Returns a learner with all values 0.

    Args:
        cmdp: the CMDP.
        rule: the budget rule, if states have a budget.
    """
    horizon, states, actions = cmdp.shape
    budget = () if rule is None else rule.levels.shape
    shape = (horizon, states, *budget, actions)
    return LearnerState(jnp.zeros(shape), jnp.zeros(shape, jnp.int32))


def step(
    key: Array,
    learner: LearnerState,
    cmdp: FiniteCMDP,
    admissible: Array,
    omega: float = 0.7,
) -> LearnerState:
    """Samples one transition and makes one update (Algorithm 4, lines 4 to 11).

    The simulator starts anywhere: time and state are drawn uniformly, and the action uniformly from
    the admissible ones. The learning rate is (1 + visits)^-omega.

    Args:
        key: random key.
        learner: the learner before the step.
        cmdp: the CMDP, from which it only samples.
        admissible: (H, S, A) bool; in insecure states only the least threatening action (lines 7 to
            9).
        omega: exponent of the learning rate, in (0.5, 1].
    """
    horizon, states, _ = cmdp.shape
    at_time, at_state, at_action, at_next = jax.random.split(key, 4)
    t = jax.random.randint(at_time, (), 0, horizon)
    s = jax.random.randint(at_state, (), 0, states)
    a = shield.masked_sample(at_action, admissible[t, s])
    arrival = jax.random.choice(at_next, states, p=cmdp.transition[s, a])
    if cmdp.horizon is None:
        after, last = jnp.asarray(0), jnp.asarray(False)
    else:
        after, last = jnp.minimum(t + 1, horizon - 1), t + 1 == horizon
    best = shield.masked_argmax(learner.values[after, arrival], admissible[after, arrival])
    ahead = jnp.where(last, 0.0, learner.values[after, arrival, best])
    target = cmdp.reward[s, a] + cmdp.gamma * ahead
    return _updated(learner, (t, s, a), target, omega)


def step_with_budget(
    key: Array, learner: LearnerState, cmdp: FiniteCMDP, rule: BudgetRule, omega: float = 0.7
) -> LearnerState:
    """Samples one transition and makes one update, with the budget as part of the state.

    As `step`, from a budget drawn uniformly as well. The action is one that this budget allows; the
    target's maximum is over what the budget left after it allows in the next state.

    Args:
        key: random key.
        learner: the learner before the step.
        cmdp: the CMDP, with a finite horizon, from which it only samples.
        rule: the budget rule.
        omega: exponent of the learning rate, in (0.5, 1].
    """
    horizon, states, _ = cmdp.shape
    at_time, at_state, at_budget, at_action, at_next = jax.random.split(key, 5)
    t = jax.random.randint(at_time, (), 0, horizon)
    s = jax.random.randint(at_state, (), 0, states)
    budget = jax.random.randint(at_budget, (), 0, len(rule.levels))
    a = shield.masked_sample(at_action, budgets.budget_actions(rule.excess[t, s], budget))
    arrival = jax.random.choice(at_next, states, p=cmdp.transition[s, a])
    left = budgets.left(budget, rule.cost[t, s, a], rule)
    after = jnp.minimum(t + 1, horizon - 1)
    allowed = budgets.budget_actions(rule.excess[after, arrival], left)
    found = learner.values[after, arrival, left]
    ahead = jnp.where(t + 1 == horizon, 0.0, found[shield.masked_argmax(found, allowed)])
    target = cmdp.reward[s, a] + cmdp.gamma * ahead
    return _updated(learner, (t, s, budget, a), target, omega)


def _updated(
    learner: LearnerState, at: tuple[Array, ...], target: Array, omega: float
) -> LearnerState:
    """Returns the learner after one value has moved towards its target."""
    rate = (1.0 + learner.visits[at]) ** -omega
    error = target - learner.values[at]
    return LearnerState(
        values=learner.values.at[at].add(rate * error),
        visits=learner.visits.at[at].add(1),
    )


def learn(
    key: Array, cmdp: FiniteCMDP, admissible: Array, steps: int, omega: float = 0.7
) -> LearnerState:
    """Learns from scratch; may be vmapped over keys for several seeds.

    Args:
        key: random key.
        cmdp: the CMDP, from which it only samples.
        admissible: (H, S, A) bool; in insecure states only the least threatening action.
        steps: number of steps.
        omega: exponent of the learning rate, in (0.5, 1].

    Raises:
        ValueError: `steps` is not a positive integer, or `omega` is out of range.
    """
    _check(steps, omega)

    def one(learner: LearnerState, key: Array) -> tuple[LearnerState, None]:
        return step(key, learner, cmdp, admissible, omega), None

    return jax.lax.scan(one, init(cmdp), jax.random.split(key, steps))[0]


def learn_with_budget(
    key: Array, cmdp: FiniteCMDP, rule: BudgetRule, steps: int, omega: float = 0.7
) -> LearnerState:
    """Learns values of step, state and budget from scratch; may be vmapped over keys.

    Args:
        key: random key.
        cmdp: the CMDP, with a finite horizon, from which it only samples.
        rule: the budget rule, from `budgets.budget_rule` or `budgets.plan_with_budget`.
        steps: number of steps.
        omega: exponent of the learning rate, in (0.5, 1].

    Raises:
        ValueError: `steps` is not a positive integer, or `omega` is out of range.
    """
    _check(steps, omega)

    def one(learner: LearnerState, key: Array) -> tuple[LearnerState, None]:
        return step_with_budget(key, learner, cmdp, rule, omega), None

    return jax.lax.scan(one, init(cmdp, rule), jax.random.split(key, steps))[0]


def _check(steps: int, omega: float) -> None:
    """Raises ValueError if a setting of learning is out of range."""
    number("steps", steps, least=1, integer=True)
    number("omega", omega, above=0.5, most=1)
