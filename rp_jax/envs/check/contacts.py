"""Hits and reach of the hazards of each kind, before and after a step."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax.envs.contract import Hazards
from rp_jax.hazards import is_static


class Contact(struct.PyTreeNode):
    """Hits and reach of the hazards of one kind in one step, () bool each."""

    hit: Array  # a hazard that is present afterwards is hit
    hit_before: Array  # a static one that was present before the step is hit
    gone: Array  # one that moves and was in reach is present no more
    beyond: Array  # one that is present and hit is not in reach
    infinite: Array  # the features of one that is present are not finite


def contacts(env: Any, before: Any, reached: Any, params: Any) -> dict[str, Contact]:
    """Returns, by kind, what one step had to do with the hazards.

    Args:
        env: the environment.
        before: the state before the step.
        reached: the state after it.
        params: the environment's parameters.
    """
    subs, found = env.sub_rmdps(params), {}
    was, now = env.hazards(before, params), env.hazards(reached, params)
    for kind, sub in subs.items():
        source, earlier, gone = sub.source, jnp.asarray(False), jnp.asarray(False)
        hits = _each(source.hits, reached.body, now[kind]) & now[kind].present
        reach = _each(source.in_reach, reached.body, now[kind])
        finite = jnp.isfinite(_each(source.features, reached.body, now[kind]))
        if is_static(source):
            earlier = jnp.any(_each(source.hits, reached.body, was[kind]) & was[kind].present)
        else:
            close = _each(source.in_reach, before.body, was[kind])
            gone = jnp.any(was[kind].present & ~now[kind].present & close)
        found[kind] = Contact(
            hit=jnp.any(hits),
            hit_before=earlier,
            gone=gone,
            beyond=jnp.any(hits & ~reach),
            infinite=jnp.any(~jnp.all(finite, axis=-1) & now[kind].present),
        )
    return found


def _each(function: Any, body: Any, group: Hazards) -> Array:
    return jax.vmap(function, (None, 0))(body, group.state)
