"""A budget of danger in place of a threshold: what an episode may still cost is part of its state.

Let the threat U(s, a) bound the danger of an action, and let m(s) be the least of the threats. For
any function m, the danger of an episode is m(s_0) plus the expected sum over its steps of V - m,
where V(s, a) is what the action taken is expected to lead to, E[d + m(s')]. So an agent to which c
was promised begins with the budget c - m(s_0), takes only actions with U(s, a) - m(s) at most its
budget, and pays V - m for each step: its expected danger is at most c, and what the threats fall
short of V beside (docs/budgets.md). There is always an action that costs nothing, and no horizon
and no threshold has to be chosen.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax.envs.contract import Env, Outcome
from rp_jax.planning.wrapped import RangedParams, Wrapped, drawn_level, ranged

LEAST = 1e-6  # budgets below are observed as this


class BudgetState(struct.PyTreeNode):
    """A state of the environment, with what its episode may still cost."""

    inner: Any  # the environment's state
    promised: Array  # () c, the danger that was promised for the episode
    budget: Array  # () what may be spent beyond the least danger
    booked: Array  # () danger booked so far: an estimate of the episode's, unbiased with refunds
    begun: Array  # () bool, a step has been settled

    @property
    def body(self) -> Any:
        """The body's state."""
        return self.inner.body

    @property
    def time(self) -> Array:
        """The number of steps since the start, () int32."""
        return self.inner.time


@dataclass(frozen=True)
class Budgeted(Wrapped):
    """An environment (`rp_jax.envs.Env`) whose states and observations include a budget."""

    def reset(self, key: Array, params: RangedParams) -> BudgetState:
        """Draws a start, and the danger c that is promised.

        Args:
            key: random key.
            params: the parameters.
        """
        start, draw = jax.random.split(key)
        return granted(self.env.reset(start, params.inner), drawn_level(draw, params))

    def step(
        self, key: Array, state: BudgetState, action: Array, params: RangedParams
    ) -> tuple[BudgetState, Outcome]:
        """Makes one transition of the environment; the budget is not settled yet (`settle`).

        Args:
            key: random key.
            state: the state before.
            action: () int.
            params: the parameters.

        Returns:
            The state after, and the step's outcome.
        """
        inner, outcome = self.env.step(key, state.inner, action, params.inner)
        return state.replace(inner=inner), outcome

    def observe(self, state: BudgetState, params: RangedParams) -> Array:
        """Returns the environment's observation, with half of log10 of the budget appended.

        Args:
            state: the state.
            params: the parameters.
        """
        seen = self.env.observe(state.inner, params.inner)
        told = 0.5 * jnp.log10(jnp.maximum(state.budget, LEAST))
        return jnp.concatenate([seen, told[None].astype(seen.dtype)])

    def remaining(self, state: BudgetState, least: Array) -> Array:
        """Returns the budget b of a state, (): what may be spent beyond the least danger.

        Args:
            state: the state.
            least: () m, the least danger that its threats leave; it is taken off c at the start.
        """
        return jnp.where(state.begun, state.budget, state.promised - least)

    def threshold(self, state: BudgetState, x: Array, least: Array) -> Array:
        """Returns the largest admissible threat m + b, (), or the cap x if that is less.

        Args:
            state: the state.
            x: () cap on every single step; infinity for none.
            least: () least threat of any action.
        """
        return jnp.minimum(x, self.remaining(state, least) + least)

    def lookahead_above(self, state: BudgetState, x: Array) -> Array:
        """Returns the least threat above which outcomes of actions are looked at, ().

        Args:
            state: the state.
            x: () cap on every single step.
        """
        return jnp.minimum(x, state.promised)

    def settle(
        self, state: BudgetState, reached: BudgetState, least: Array, danger: Array
    ) -> BudgetState:
        """Returns the state reached, after the step has been paid for.

        What is refunded beyond c is forgone: no step may risk more than was promised for the whole
        episode. What goes beyond the budget is forgiven: only the least threatening action is left
        then, and a debt would forbid no more. That happens where the threats were too low, or by
        chance in an estimate of the danger; it stays booked, so that what it costs is known.

        Args:
            state: the state before the step.
            reached: the state after it.
            least: () m, the least danger that the threats left before the step.
            danger: () V, the danger that the action is expected to lead to.
        """
        left = self.remaining(state, least) + least - danger
        return reached.replace(
            budget=jnp.clip(left, 0.0, state.promised),
            booked=state.booked + jnp.where(state.begun, danger - least, danger),
            begun=jnp.ones_like(state.begun),
        )

    def promised(self, state: BudgetState) -> Array:
        """Returns the danger c that was promised for a state's episode, ().

        Args:
            state: the state.
        """
        return state.promised


def granted(state: Any, c: Array) -> BudgetState:
    """Returns a state at which an episode begins that may have danger c.

    Args:
        state: of the environment.
        c: () danger.
    """
    promised, budget = jnp.array(c), jnp.array(c)  # copies: each field has memory of its own
    none = jnp.zeros_like(promised)
    return BudgetState(state, promised, budget, none, jnp.zeros(none.shape, bool))


def unwrapped(env: Env, params: Any) -> tuple[Env, Any]:
    """Returns a world and its parameters without a budget, if they have one.

    Args:
        env: the world.
        params: its parameters.
    """
    if not isinstance(env, Budgeted):
        return env, params
    return env.env, params.inner if isinstance(params, RangedParams) else params


def with_budget(env: Env, params: Any, low: float, high: float) -> tuple[Budgeted, RangedParams]:
    """Returns a world whose episodes each have a budget, and its parameters.

    Args:
        env: the world.
        params: its parameters.
        low: least danger c that is promised.
        high: greatest; c is drawn between both, its logarithm uniformly.

    Raises:
        ValueError: 0 < low <= high does not hold.
    """
    return Budgeted(env), ranged(params, low, high)
