"""An environment with something more in its states: what all such have in common."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax.copies import parts
from rp_jax.envs import optional
from rp_jax.envs.contract import Env, Hazards
from rp_jax.hazards import SubRMDP
from rp_jax.shield import threshold_array
from rp_jax.validate import number


class RangedParams(struct.PyTreeNode):
    """An environment's parameters, with the range of a level that is drawn for each episode."""

    inner: Any  # the environment's parameters
    low: Array  # () least level
    high: Array  # () greatest level

    @property
    def body(self) -> Any:
        """The body's model."""
        return self.inner.body

    @property
    def time_limit(self) -> Array:
        """The number of steps of an episode, () int32."""
        return self.inner.time_limit


def ranged(inner: Any, low: float, high: float) -> RangedParams:
    """Returns parameters with levels spread evenly over the orders of magnitude of a range.

    Args:
        inner: the environment's parameters.
        low: least level, greater than 0.
        high: greatest level.

    Raises:
        ValueError: 0 < low <= high does not hold.
    """
    number("low", low, above=0)
    number("high", high, least=low)
    least, most = (threshold_array(x) for x in (low, high))
    return RangedParams(inner, least, most)


def drawn_level(key: Array, params: RangedParams) -> Array:
    """Draws a level, its logarithm uniformly, ().

    Args:
        key: random key.
        params: with the range.
    """
    low, high = jnp.log(params.low), jnp.log(params.high)
    level = jnp.exp(low + jax.random.uniform(key, (), low.dtype) * (high - low))
    return jnp.clip(level, params.low, params.high)


@dataclass(frozen=True)
class Wrapped:
    """Base of environments (`rp_jax.envs.Env`) that add one value to another's observation.

    States have the environment's own state as `inner`.
    """

    env: Env  # the environment inside

    __reduce__ = parts

    @property
    def LIDAR_BINS(self) -> int:  # noqa: N802
        """How many of an observation's first values are distances of a LIDAR."""
        return optional.lidar_bins(self.env)

    @property
    def SCALE(self) -> tuple[float, ...]:  # noqa: N802
        """The factors of the rest of an observation, for learners."""
        scale = optional.scale(self.env)
        return (*scale, 1.0) if scale else ()

    def hazards(self, state: Any, params: RangedParams) -> dict[str, Hazards]:
        """Returns, by kind, the hazards that `sub_rmdps` has threats for.

        Args:
            state: the state.
            params: the parameters.
        """
        return self.env.hazards(state.inner, params.inner)

    def collisions(self, state: Any, params: RangedParams) -> dict[str, Array]:
        """Returns, by kind, whether a hazard is being hit, () bool each.

        Args:
            state: the state.
            params: the parameters.
        """
        return optional.collisions(self.env, state.inner, params.inner)

    def clearance(self, position: Array, params: RangedParams) -> Array:
        """Returns the distance left between the body and the nearest fixed hazard, () room units.

        Args:
            position: (2,) of the body.
            params: the parameters.
        """
        return optional.clearance(self.env, position, params.inner)

    def sub_rmdps(self, params: RangedParams) -> dict[str, SubRMDP]:
        """Returns, by kind, the sub-R-MDP of the body and one hazard.

        Args:
            params: the parameters.
        """
        return self.env.sub_rmdps(params.inner)

    def num_actions(self, params: RangedParams) -> int:
        """Returns the size of the discrete action set.

        Args:
            params: the parameters.
        """
        return optional.num_actions(self.env, params.inner)
