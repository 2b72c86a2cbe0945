"""The joint threat of all fixed hazards: no sum over them, and no model.

Plans are deterministic, and fixed hazards stay where they are: whether a plan meets any of them
on its way to a halt is known exactly, and for ever. So it is 0 or certain.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.kinematics import AgentModel, Plans, Vehicle

MARGIN = 1e-4  # room units by which a way must be clear; rounding moves it by less in an episode


def plan_clearance(agent: Vehicle, model: AgentModel, clearance: Callable[[Array], Array]) -> Array:
    """(K, A) least clearance on the way of each plan after each first action.

    Args:
        agent: unbatched.
        model: its baseline is K plans.
        clearance: from a position (2,) to the room left there, () room units.
    """
    plans = model.baseline
    assert isinstance(plans, Plans)

    def way(plan: Plans, action) -> Array:
        def onward(carry, k):
            us, least = carry
            us = model.step(us, plan.control(k, us.speed))
            return (us, jnp.minimum(least, clearance(us.position))), None

        first = model.step(agent, action)
        begin = (first, clearance(first.position))
        # A loop: unrolled, it takes twice as long to run and to compile.
        return jax.lax.scan(onward, begin, jnp.arange(plans.horizon - 1))[0][1]

    return jax.vmap(jax.vmap(way, (None, 0)), (plans.axes, None))(plans, model.actions)


def static_threat(clearance: Array) -> Array:
    """Threats (...) of ways with these clearances: 0, or from 2 to 3.

    Any value from 1 on bounds the probability of a certain hit. These are graded, so that where no
    plan is clear by the margin, the clearest is the least threatening; and greater than any threat
    of the moving hazards.
    """
    short = jnp.clip((MARGIN - clearance) / (MARGIN + 1.0), 0.0, 1.0)
    return jnp.where(clearance >= MARGIN, 0.0, 2.0 + short)


def bounded(total: Array) -> Array:
    """Sums of threats (...) as they are up to 1; greater ones brought into (1, 1.5), in order."""
    return jnp.where(total <= 1, total, 1.5 - 0.5 / jnp.maximum(total, 1.0))
