"""Where sub-R-MDP rollouts start: uniformly over the window, or where it matters (section 4.1).

A start is drawn as features, from which the hazard source restores the states.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.hazards import SubRMDP

POOL = 4  # candidates per state that is drawn preferentially
FLOOR = 0.05  # interest that every candidate has at least, so that none is out of the question


@functools.partial(jax.jit, static_argnames="count")
def uniform(key: Array, sub: SubRMDP, count: int) -> Array:
    """(count, F) features, spread over the window and all speeds."""

    def one(key: Array) -> Array:
        return sub.source.features(*sub.source.sample(key, sub.agent))

    return jax.vmap(one)(jax.random.split(key, count))


@jax.jit
def states(sub: SubRMDP, features: Array) -> tuple[Any, Any]:
    """The agents and hazards (n, ...) that features (n, F) were drawn from."""
    return jax.vmap(sub.source.state_of)(features)


def interest(threat: Array, x: Any) -> Array:
    """(...) how much the threats (..., A) of a state matter: near x, or far from certain.

    Each action counts 1 where its threat is x, falling to 1/e at a factor of 4 from it, and up
    to 1/2 where it is neither 0 nor 1.
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
    """(count, F) features of states that matter: threat near x, or the model in error.

    A pool of candidates, half of them uniform and half of them near labelled states on which the
    model errs, is thinned by `interest` in what the model says of them.

    Args:
        key: of the draw.
        sub: the sub-R-MDP.
        model: maps features (..., F) to threats (..., A); fitted to the labels so far.
        features: (n, F) of the states labelled so far.
        threat: (n, A) their labels.
        x: the threshold that matters.
        count: how many to draw.
    """
    spread_key, pick_key, shift_key, thin_key = jax.random.split(key, 4)
    half = count * POOL // 2
    spread = uniform(spread_key, sub, count * POOL - half)
    error = jnp.mean(jnp.abs(model(features) - threat), axis=-1)
    rows = jax.random.choice(pick_key, len(features), (half,), p=error / jnp.sum(error))
    fresh = uniform(shift_key, sub, half)
    # A step of a twentieth towards a uniform draw stays in reach, or nearly so.
    near = features[rows] + 0.05 * (fresh - features[rows])
    # Features that no state has (a heading that is not of unit length) are brought back.
    near = jax.vmap(sub.source.features)(*states(sub, near))
    candidates = jnp.concatenate([spread, near])
    weight = FLOOR + interest(model(candidates), x)
    # Gumbel noise draws without replacement, in proportion to the weights.
    noise = jax.random.gumbel(thin_key, (len(candidates),))
    return candidates[jnp.argsort(-(jnp.log(weight) + noise))[:count]]
