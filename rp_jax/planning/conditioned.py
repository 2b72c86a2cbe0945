"""One planner for all thresholds: x is drawn at the start of each episode, and observed.

Since the threat function does not depend on x, one Q-network can learn the P-MDPs of all x at once.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax.envs import optional
from rp_jax.envs.contract import Env, Hazards, Outcome
from rp_jax.hazards import SubRMDP
from rp_jax.planning.pmdp import PMDP
from rp_jax.shield import rounded_down
from rp_jax.validate import number


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


class ConditionedParams(struct.PyTreeNode):
    """The environment's parameters, with the range of x."""

    inner: Any  # the environment's parameters
    low: Array  # () least x
    high: Array  # () greatest x

    @property
    def body(self) -> Any:
        """The body's model."""
        return self.inner.body

    @property
    def time_limit(self) -> Array:
        """The number of steps of an episode, () int32."""
        return self.inner.time_limit


def make_params(inner: Any, low: float, high: float) -> ConditionedParams:
    """Returns parameters with thresholds spread evenly over the orders of magnitude of a range.

    Args:
        inner: the environment's parameters.
        low: least threshold, greater than 0.
        high: greatest threshold.

    Raises:
        ValueError: 0 < low <= high does not hold.
    """
    number("low", low, above=0)
    number("high", high, least=low)
    least, most = (jnp.asarray(rounded_down(x), float) for x in (low, high))
    return ConditionedParams(inner, least, most)


@dataclass(frozen=True)
class Conditioned:
    """An environment (`rp_jax.envs.Env`) whose states and observations include the threshold x."""

    env: Env  # the environment without x

    @property
    def LIDAR_BINS(self) -> int:  # noqa: N802
        """How many of an observation's first values are distances of a LIDAR."""
        return optional.lidar_bins(self.env)

    @property
    def SCALE(self) -> tuple[float, ...]:  # noqa: N802
        """The factors of the rest of an observation, for learners."""
        scale = optional.scale(self.env)
        return (*scale, 1.0) if scale else ()

    def reset(self, key: Array, params: ConditionedParams) -> ConditionedState:
        """Draws a start and a threshold.

        Args:
            key: random key.
            params: the parameters.
        """
        start, draw = jax.random.split(key)
        low, high = jnp.log(params.low), jnp.log(params.high)
        x = jnp.exp(low + jax.random.uniform(draw, (), low.dtype) * (high - low))
        x = jnp.clip(x, params.low, params.high)
        return ConditionedState(self.env.reset(start, params.inner), x)

    def step(
        self, key: Array, state: ConditionedState, action: Array, params: ConditionedParams
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

    def threshold(self, state: ConditionedState) -> Array:
        """Returns the largest admissible threat of a state's episode, ().

        Args:
            state: the state.
        """
        return state.x

    def observe(self, state: ConditionedState, params: ConditionedParams) -> Array:
        """Returns the environment's observation, with half of log10 x appended.

        Args:
            state: the state.
            params: the parameters.
        """
        seen = self.env.observe(state.inner, params.inner)
        return jnp.concatenate([seen, 0.5 * jnp.log10(state.x)[None].astype(seen.dtype)])

    def hazards(self, state: ConditionedState, params: ConditionedParams) -> dict[str, Hazards]:
        """Returns, by kind, the hazards that `sub_rmdps` has threats for.

        Args:
            state: the state.
            params: the parameters.
        """
        return self.env.hazards(state.inner, params.inner)

    def collisions(self, state: ConditionedState, params: ConditionedParams) -> dict[str, Array]:
        """Returns, by kind, whether a hazard is being hit, () bool each.

        Args:
            state: the state.
            params: the parameters.
        """
        return optional.collisions(self.env, state.inner, params.inner)

    def clearance(self, position: Array, params: ConditionedParams) -> Array:
        """Returns the distance left between the body and the nearest fixed hazard, () room units.

        Args:
            position: (2,) of the body.
            params: the parameters.
        """
        return optional.clearance(self.env, position, params.inner)

    def sub_rmdps(self, params: ConditionedParams) -> dict[str, SubRMDP]:
        """Returns, by kind, the sub-R-MDP of the body and one hazard.

        Args:
            params: the parameters.
        """
        return self.env.sub_rmdps(params.inner)

    def num_actions(self, params: ConditionedParams) -> int:
        """Returns the size of the discrete action set.

        Args:
            params: the parameters.
        """
        return optional.num_actions(self.env, params.inner)


def condition(pmdp: PMDP, low: float, high: float) -> PMDP:
    """Returns the P-MDPs of all thresholds in a range as one.

    Args:
        pmdp: the P-MDP of any threshold.
        low: least threshold, greater than 0.
        high: greatest threshold.

    Raises:
        ValueError: 0 < low <= high does not hold.
    """
    return pmdp.replace(params=make_params(pmdp.params, low, high), env=Conditioned(pmdp.env))
