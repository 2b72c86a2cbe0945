"""The joint threat of all fixed hazards, exact and without a model.

Plans are deterministic, and fixed hazards do not move: whether a plan hits one of them before it
comes to rest is known exactly. So the threat is either 0 or certain, and need not be summed.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.dynamics import Plans, Vehicle, VehicleModel

MARGIN = 1e-4  # room units by which a path must be clear; rounding errors in an episode are less


def plan_clearance(
    body: Vehicle, model: VehicleModel, clearance: Callable[[Array], Array]
) -> Array:
    """Returns the least clearance along the path of each plan after each first action.

    Args:
        body: the body's state, unbatched.
        model: the body's model; its baseline policies must be K plans.
        clearance: maps a position (2,) to the distance left there to the nearest fixed hazard, ()
            room units.

    Returns:
        (K, A) room units.
    """
    plans = model.baseline
    assert isinstance(plans, Plans)

    def way(plan: Plans, action) -> Array:
        def onward(carry, k):
            us, least = carry
            us = model.step(us, plan.control(k, us.speed))
            return (us, jnp.minimum(least, clearance(us.position))), None

        first = model.step(body, action)
        begin = (first, clearance(first.position))
        # A loop: unrolled, it takes twice as long to run and to compile.
        return jax.lax.scan(onward, begin, jnp.arange(plans.horizon - 1))[0][1]

    return jax.vmap(jax.vmap(way, (None, 0)), (plans.axes, None))(plans, model.actions)


def static_threat(clearance: Array) -> Array:
    """Returns the threats of paths with given clearances: 0, or from 2 to 3.

    Every value from 1 on is an upper bound of the probability of a hit. The values are graded, so
    that where no plan is clear the one with the greatest clearance is the least threatening; and
    they are greater than the threat of moving hazards (see `compress_above_one`).

    Args:
        clearance: (...) room units.

    Returns:
        (...).
    """
    short = jnp.clip((MARGIN - clearance) / (MARGIN + 1.0), 0.0, 1.0)
    return jnp.where(clearance >= MARGIN, 0.0, 2.0 + short)


def compress_above_one(total: Array) -> Array:
    """Leaves threats up to 1 unchanged, and maps greater ones into (1, 1.5) in the same order.

    Args:
        total: (...) sums of threats.
    """
    return jnp.where(total <= 1, total, 1.5 - 0.5 / jnp.maximum(total, 1.0))
