"""One planner for all thresholds: x is drawn at the start of each episode, and seen.

The threat function does not depend on x, so one Q-network may learn the P-MDPs of all x at once.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax.envs.base import Env, Hazards, Outcome
from rp_jax.hazards import SubRMDP
from rp_jax.planning.pmdp import PMDP
from rp_jax.validate import number


class State(struct.PyTreeNode):
    """A state of the environment, and the threshold of its episode."""

    inner: Any
    x: Array  # ()

    @property
    def agent(self) -> Any:
        """The agent of the environment's state."""
        return self.inner.agent

    @property
    def time(self) -> Array:
        """() int32, steps since the start."""
        return self.inner.time


class Params(struct.PyTreeNode):
    """The environment's parameters, and the range of x."""

    inner: Any
    low: Array  # () least x
    high: Array  # () greatest x

    @property
    def agent(self) -> Any:
        """The agent model of the environment."""
        return self.inner.agent

    @property
    def time_limit(self) -> Array:
        """() int32, steps of an episode at most."""
        return self.inner.time_limit


def make_params(inner: Any, low: float, high: float) -> Params:
    """Thresholds spread evenly over the orders of magnitude from `low` to `high`.

    Raises:
        ValueError: not 0 < low <= high.
    """
    number("low", low, above=0)
    number("high", high, least=low)
    return Params(inner, jnp.asarray(low, float), jnp.asarray(high, float))


@dataclass(frozen=True)
class Conditioned:
    """An environment (`rp_jax.envs.base.Env`) whose states and observations carry x."""

    env: Env

    @property
    def LIDAR_BINS(self) -> int:  # noqa: N802
        """See `Env`."""
        return self.env.LIDAR_BINS

    @property
    def SCALE(self) -> tuple[float, ...]:  # noqa: N802
        """See `Env`; the last is that of log10 x."""
        return (*self.env.SCALE, 0.5)

    def reset(self, key: Array, params: Params) -> State:
        """Draws a start and a threshold."""
        start, draw = jax.random.split(key)
        low, high = jnp.log(params.low), jnp.log(params.high)
        x = jnp.exp(low + jax.random.uniform(draw, (), low.dtype) * (high - low))
        x = jnp.clip(x, params.low, params.high)
        return State(self.env.reset(start, params.inner), x)

    def step(
        self, key: Array, state: State, action: Array, params: Params
    ) -> tuple[State, Outcome]:
        """One transition of the environment."""
        inner, outcome = self.env.step(key, state.inner, action, params.inner)
        return state.replace(inner=inner), outcome

    def observe(self, state: State, params: Params) -> Array:
        """The environment's observation, and log10 x."""
        seen = self.env.observe(state.inner, params.inner)
        return jnp.concatenate([seen, jnp.log10(state.x)[None].astype(seen.dtype)])

    def hazards(self, state: State, params: Params) -> dict[str, Hazards]:
        """See `Env`."""
        return self.env.hazards(state.inner, params.inner)

    def causes(self, state: State, params: Params) -> dict[str, Array]:
        """See `Env`."""
        return self.env.causes(state.inner, params.inner)

    def clearance(self, position: Array, params: Params) -> Array:
        """See `Env`."""
        return self.env.clearance(position, params.inner)

    def sub_rmdps(self, params: Params) -> dict[str, SubRMDP]:
        """See `Env`."""
        return self.env.sub_rmdps(params.inner)

    def num_actions(self, params: Params) -> int:
        """See `Env`."""
        return self.env.num_actions(params.inner)


class ConditionedPMDP(PMDP):
    """Equation 10 with each episode's own threshold: threats are in units of x, which is 1."""

    def threat(self, states: State, alive: Array | None = None) -> Array:
        """(B, A) total threat over x; rounded up, so that nothing is admitted for rounding."""
        ratio = super().threat(states, alive) / states.x[:, None]
        return ratio * (1 + float(jnp.finfo(ratio.dtype).eps))

    def _threshold(self, states: State) -> Array:
        return states.x


def condition(pmdp: PMDP, low: float, high: float) -> ConditionedPMDP:
    """The P-MDPs of all thresholds from `low` to `high` in one."""
    return ConditionedPMDP(
        params=make_params(pmdp.params, low, high),
        threats=pmdp.threats,
        x=jnp.ones_like(pmdp.x),
        penalty=pmdp.penalty,
        toll=pmdp.toll,
        env=Conditioned(pmdp.env),
        pool=pmdp.pool,
        lookahead=pmdp.lookahead,
    )
