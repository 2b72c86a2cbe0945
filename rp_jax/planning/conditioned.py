"""One planner for all thresholds: x is drawn at the start of each episode, and observed.

Since the threat function does not depend on x, one Q-network can learn the P-MDPs of all x at once.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax.envs.contract import Outcome
from rp_jax.planning.pmdp import PMDP
from rp_jax.planning.wrapped import RangedParams, Wrapped, drawn_level, ranged


class ConditionedState(struct.PyTreeNode):
    """A state of the environment, with the threshold of its episode."""

    inner: Any  # the environment's state
    x: Array  # () threshold

    @property
    def body(self) -> Any:
        """The body's state."""
        return self.inner.body

    @property
    def time(self) -> Array:
        """The number of steps since the start, () int32."""
        return self.inner.time


@dataclass(frozen=True)
class Conditioned(Wrapped):
    """An environment (`rp_jax.envs.Env`) whose states and observations include the threshold x."""

    def reset(self, key: Array, params: RangedParams) -> ConditionedState:
        """Draws a start and a threshold.

        Args:
            key: random key.
            params: the parameters.
        """
        start, draw = jax.random.split(key)
        x = drawn_level(draw, params)
        return ConditionedState(self.env.reset(start, params.inner), x)

    def step(
        self, key: Array, state: ConditionedState, action: Array, params: RangedParams
    ) -> tuple[ConditionedState, Outcome]:
        """Makes one transition of the environment; the threshold stays the same.

        Args:
            key: random key.
            state: the state before.
            action: () int, or floats where actions are continuous.
            params: the parameters.

        Returns:
            The state after, and the step's outcome.
        """
        inner, outcome = self.env.step(key, state.inner, action, params.inner)
        return state.replace(inner=inner), outcome

    def threshold(self, state: ConditionedState, x: Array, least: Array) -> Array:
        """Returns the largest admissible threat of a state's episode, ().

        Args:
            state: the state.
            x: () is not used, like `least`: the state has its own.
            least: () least threat of any action.
        """
        return state.x

    def observe(self, state: ConditionedState, params: RangedParams) -> Array:
        """Returns the environment's observation, with half of log10 x appended.

        Args:
            state: the state.
            params: the parameters.
        """
        seen = self.env.observe(state.inner, params.inner)
        return jnp.concatenate([seen, 0.5 * jnp.log10(state.x)[None].astype(seen.dtype)])


def condition(pmdp: PMDP, low: float, high: float) -> PMDP:
    """Returns the P-MDPs of all thresholds in a range as one.

    Args:
        pmdp: the P-MDP of any threshold.
        low: least threshold, greater than 0.
        high: greatest threshold.

    Raises:
        ValueError: 0 < low <= high does not hold.
    """
    return pmdp.replace(params=ranged(pmdp.params, low, high), env=Conditioned(pmdp.env))
