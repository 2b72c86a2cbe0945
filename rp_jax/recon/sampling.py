"""States in which rollouts of a sub-R-MDP start: uniform, or where they matter (section 4.1).

A state is drawn as features, from which the hazard source restores body and hazard.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.hazards import SubRMDP

POOL = 4  # number of candidates for each state that is drawn preferentially
FLOOR = 0.05  # added to the interest of every candidate, so that each may be drawn


@functools.partial(jax.jit, static_argnames="count")
def uniform(key: Array, sub: SubRMDP, count: int) -> Array:
    """Draws features of states spread over the hazard's window and all speeds.

    Args:
        key: random key.
        sub: the sub-R-MDP.
        count: number of states.

    Returns:
        (count, F) features.
    """

    def one(key: Array) -> Array:
        return sub.source.features(*sub.source.sample(key, sub.body))

    return jax.vmap(one)(jax.random.split(key, count))


@jax.jit
def states(sub: SubRMDP, features: Array) -> tuple[Any, Any]:
    """Returns the states of body and hazard that features were drawn for.

    Args:
        sub: the sub-R-MDP.
        features: (n, F).

    Returns:
        States of the body and of the hazard, leading axis (n,).
    """
    return jax.vmap(sub.source.state_of)(features)


def interest(threat: Array, x: Any) -> Array:
    """Returns how much a state matters for learning: threats near x, or far from certain.

    Each action contributes 1 where its threat is x, falling to 1/e at a factor of 4 from it, and up
    to 1/2 where its threat is neither 0 nor 1; the result is the mean over actions.

    Args:
        threat: (..., A) threats of the actions.
        x: () threshold.

    Returns:
        (...) from 0 to 1.5.
    """
    ratio = jnp.log(jnp.maximum(threat, 1e-9) / x) / jnp.log(4.0)
    return jnp.mean(jnp.exp(-jnp.square(ratio)) + jnp.sqrt(threat * (1 - threat)), axis=-1)


def preferential(
    key: Array,
    sub: SubRMDP,
    model: Callable[[Array], Array],
    features: Array,
    threat: Array,
    x: Any,
    count: int,
) -> Array:
    """Draws features of states that matter: with threats near x, or with large errors of a model.

    A pool of candidates, half of them uniform and half of them close to labelled states where the
    model errs, is thinned out in proportion to `interest` in what the model predicts for them.

    Args:
        key: random key.
        sub: the sub-R-MDP.
        model: maps features (..., F) to threats (..., A); fitted to the labels so far.
        features: (n, F) features of the states labelled so far.
        threat: (n, A) their labels.
        x: () threshold.
        count: number of states to draw.

    Returns:
        (count, F) features.
    """
    spread_key, pick_key, shift_key, thin_key = jax.random.split(key, 4)
    half = count * POOL // 2
    spread = uniform(spread_key, sub, count * POOL - half)
    error = jnp.mean(jnp.abs(model(features) - threat), axis=-1)
    rows = jax.random.choice(pick_key, len(features), (half,), p=error / jnp.sum(error))
    fresh = uniform(shift_key, sub, half)
    # A step of a twentieth towards a uniform draw stays in reach, or almost.
    near = features[rows] + 0.05 * (fresh - features[rows])
    # Features that no state has (a heading that is not of unit length) are replaced by valid ones.
    near = jax.vmap(sub.source.features)(*states(sub, near))
    candidates = jnp.concatenate([spread, near])
    weight = FLOOR + interest(model(candidates), x)
    # Gumbel noise draws without replacement, in proportion to the weights.
    noise = jax.random.gumbel(thin_key, (len(candidates),))
    return candidates[jnp.argsort(-(jnp.log(weight) + noise))[:count]]
