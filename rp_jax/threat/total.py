"""The threat of a whole state: the sum over its hazards (Theorem 3), in one batched call."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.envs.base import Hazards, packed
from rp_jax.threat.model import ThreatModel

CHUNK = 256  # rows per call of a network; fixed, so that no result depends on the batch


def total_threat(
    models: Mapping[str, ThreatModel], agents: Any, hazards: Mapping[str, Hazards]
) -> Array:
    """sum_n T_n(s, .) over all hazards in reach, for a batch of states (Theorem 3).

    The theorem bounds rollouts that are not cut: the models' horizon leaves out what happens after
    it, up to beta^horizon per unit of danger.

    Args:
        models: by kind of hazard.
        agents: agent states, leading axis (B,).
        hazards: by kind, states with leading axes (B, n) and which of them are present (B, n).

    Returns:
        (B, A). The sum is rounded up by the error of adding in floating point, so that nothing
        is admitted for rounding's sake.

    Raises:
        ValueError: a kind of hazard has no model.
    """
    missing = sorted(set(hazards) - set(models))
    if missing:
        raise ValueError(
            f"models: no threat model for {', '.join(missing)}; there are models for "
            f"{', '.join(sorted(models))}"
        )
    parts = [_summed(models[kind], agents, hazards[kind]) for kind in sorted(hazards)]
    total = jnp.sum(jnp.stack(parts), axis=0)
    terms = sum(group.present.shape[1] for group in hazards.values())
    return total * (1 + (terms + 1) * float(jnp.finfo(total.dtype).eps))


def counted(source: Any, agents: Any, hazards: Hazards) -> Array:
    """(B, n) bool, the hazards of one kind that are present and in reach of agents (B, ...)."""
    reached = jax.vmap(jax.vmap(source.in_reach, (None, 0)))(agents, hazards.state)
    return reached & hazards.present


def _summed(model: ThreatModel, agents: Any, hazards: Hazards) -> Array:
    """(B, A) of one kind. Only hazards in reach are shown to the network.

    They are packed tightly first: few of the candidates are in reach, and how many varies much
    from state to state.
    """
    over_hazards = jax.vmap(model.source.features, (None, 0))
    features = jax.vmap(over_hazards)(agents, hazards.state)  # (B, n, F)
    inside = counted(model.source, agents, hazards)
    batch, n = inside.shape
    if n == 0:
        return jnp.zeros((batch, model.network.num_actions), features.dtype)
    order, count = packed(inside.reshape(-1), CHUNK, 0)
    rows = features.reshape(batch * n, -1)

    def add_chunk(carry):
        start, total = carry
        chosen = jax.lax.dynamic_slice(order, (start,), (CHUNK,))
        threat = model(rows[chosen])
        real = start + jnp.arange(CHUNK) < count
        threat = jnp.where(real[:, None], threat, 0.0)
        return start + CHUNK, total.at[chosen // n].add(threat)

    nothing = jnp.zeros((batch, model.network.num_actions), features.dtype)
    return jax.lax.while_loop(lambda c: c[0] < count, add_chunk, (0, nothing))[1]
