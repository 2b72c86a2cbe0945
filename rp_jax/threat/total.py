"""The threat of a whole state: the sum over its hazards (Theorem 3), in one batched call."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.arrays import compact_indices
from rp_jax.envs.contract import Hazards
from rp_jax.threat.model import ThreatModel

CHUNK = 256  # rows in a call of a network; fixed, so that results do not depend on the batch


def total_threat(
    models: Mapping[str, ThreatModel], bodies: Any, hazards: Mapping[str, Hazards]
) -> Array:
    """Returns sum_n T_n(s, .) over all hazards in reach, for a batch of states (Theorem 3).

    The theorem holds for rollouts that are not cut. The models' rollouts end at their horizon, and
    leave out what happens later, up to beta^horizon for each unit of danger.

    Args:
        models: the models by kind of hazard.
        bodies: states of the body, leading axis (B,).
        hazards: by kind, the hazards of each state, with leading axes (B, n).

    Returns:
        (B, A). The sum is rounded up by the error of floating-point addition, so that no action is
        admitted because of rounding.

    Raises:
        ValueError: a kind of hazard has no model.
    """
    missing = sorted(set(hazards) - set(models))
    if missing:
        raise ValueError(
            f"models: no threat model for {', '.join(missing)}; there are models for "
            f"{', '.join(sorted(models))}"
        )
    parts = [_summed(models[kind], bodies, hazards[kind]) for kind in sorted(hazards)]
    total = jnp.sum(jnp.stack(parts), axis=0)
    terms = sum(group.present.shape[1] for group in hazards.values())
    return total * (1 + (terms + 1) * float(jnp.finfo(total.dtype).eps))


def counted(source: Any, bodies: Any, hazards: Hazards) -> Array:
    """Returns which hazards of one kind count: those that are present and in reach.

    Args:
        source: the kind of hazard.
        bodies: states of the body, leading axis (B,).
        hazards: the hazards, leading axes (B, n).

    Returns:
        (B, n) bool.
    """
    reached = jax.vmap(jax.vmap(source.in_reach, (None, 0)))(bodies, hazards.state)
    return reached & hazards.present


def _summed(model: ThreatModel, bodies: Any, hazards: Hazards) -> Array:
    """Returns the sum (B, A) over the hazards of one kind.

    Only those in reach go through the network: they are few, and are moved to the front first.
    """
    inside = counted(model.source, bodies, hazards)
    batch, n = inside.shape
    nothing = jnp.zeros((batch, model.network.num_actions))
    if n == 0:
        return nothing
    order, count = compact_indices(inside.reshape(-1), CHUNK, 0)
    flat = jax.tree.map(lambda a: a.reshape(batch * n, *a.shape[2:]), hazards.state)

    def add_chunk(carry):
        start, total = carry
        chosen = jax.lax.dynamic_slice(order, (start,), (CHUNK,))
        body = _rows(bodies, chosen // n)
        hazard = _rows(flat, chosen)
        threat = model(jax.vmap(model.source.features)(body, hazard))
        real = start + jnp.arange(CHUNK) < count
        threat = jnp.where(real[:, None], threat, 0.0)
        return start + CHUNK, total.at[chosen // n].add(threat)

    return jax.lax.while_loop(lambda c: c[0] < count, add_chunk, (0, nothing))[1]


def _rows(states: Any, chosen: Array) -> Any:
    """Returns the chosen rows of a batch; all of them exist."""
    return jax.tree.map(lambda a: a.at[chosen].get(mode="promise_in_bounds"), states)
