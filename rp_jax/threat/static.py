"""The joint threat of all fixed hazards, exact and without a model.

Plans are deterministic, and fixed hazards do not move: whether a plan hits one of them before it
comes to rest is known exactly. So the threat is either 0 or certain, and need not be summed.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.arrays import replace_rows
from rp_jax.dynamics import Plans, Vehicle, VehicleModel

MARGIN = 1e-4  # room units by which a path must be clear; rounding errors in an episode are less
SAME = 1e-6  # speeds that differ by less lead to the same paths, up to a tenth of `MARGIN`
UNROLLED = 3  # steps of paths looked at in one turn of a loop


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


def plan_clearances(bodies: Any, model: Any, clearance: Callable[[Array], Array]) -> Array:
    """Returns the least clearances of `plan_clearance` for a batch of bodies, (B, K, A).

    Two vehicles of one speed drive the same paths, each seen from where it stands. So the paths are
    followed once for each of the reachable speeds, and then moved to each vehicle. Vehicles of
    other speeds, and other bodies, are followed one by one.

    Args:
        bodies: states, leading axis (B,).
        model: the body's model; its baseline policies must be K plans.
        clearance: as for `plan_clearance`.
    """
    each = jax.vmap(lambda body: plan_clearance(body, model, clearance))
    plans = model.baseline
    assert isinstance(plans, Plans)
    if type(model) is not VehicleModel or model.room is not None:
        return each(bodies)
    gaps = jnp.abs(bodies.speed[:, None] - model.speeds[None])
    nearest = jnp.argmin(gaps, axis=1)
    found = _moved_clearances(bodies, nearest, _paths(model), clearance)
    shape = (len(bodies.speed), len(plans.target), len(model.actions.acceleration))

    def follow(rows: Array) -> Array:
        return each(jax.tree.map(lambda a: a.at[rows].get(mode="clip"), bodies))

    return replace_rows(jnp.min(gaps, axis=1) > SAME, found.reshape(shape), follow, chunk=4)


def _paths(model: VehicleModel) -> Array:
    """Returns where plans lead from the origin, along x, at each speed: (T, 2, S, K * A)."""
    plans = model.baseline
    assert isinstance(plans, Plans)

    def way(speed: Array, plan: Plans, action: Any) -> Array:
        def onward(body: Vehicle, k: Array) -> tuple[Vehicle, Array]:
            moved = model.step(body, plan.control(k, body.speed))
            return moved, moved.position

        begin = Vehicle(jnp.zeros(2, speed.dtype), jnp.eye(2, dtype=speed.dtype)[0], speed)
        first = model.step(begin, action)
        rest = jax.lax.scan(onward, first, jnp.arange(plans.horizon - 1))[1]
        return jnp.concatenate([first.position[None], rest])

    actions = jax.vmap(way, (None, None, 0))
    each = jax.vmap(jax.vmap(actions, (None, plans.axes, None)), (0, None, None))
    paths = each(model.speeds, plans, model.actions)  # (S, K, A, T, 2)
    return jnp.moveaxis(paths, (3, 4), (0, 1)).reshape(*paths.shape[3:], paths.shape[0], -1)


def _moved_clearances(
    bodies: Vehicle, which: Array, paths: Array, clearance: Callable[[Array], Array]
) -> Array:
    """Returns the least clearances (B, K * A) along paths that are moved to where bodies are.

    Args:
        bodies: states, leading axis (B,).
        which: (B,) int, index of each body's speed.
        paths: (T, 2, S, K * A).
        clearance: as for `plan_clearance`.
    """
    cos, sin = bodies.heading[:, :1], bodies.heading[:, 1:]
    left, up = bodies.position[:, :1], bodies.position[:, 1:]

    def at(path: Array) -> Array:
        x, y = path[0][which], path[1][which]
        place = jnp.stack([left + cos * x - sin * y, up + sin * x + cos * y], axis=-1)
        return jax.vmap(jax.vmap(clearance))(place)

    def onward(least: Array, path: Array) -> tuple[Array, None]:
        return jnp.minimum(least, at(path)), None

    return jax.lax.scan(onward, at(paths[0]), paths[1:], unroll=UNROLLED)[0]


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
