"""A learned threat function of one kind of hazard, T_n(s, .) for all actions at once."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct
from jax import Array

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"relu": nn.relu, "silu": nn.silu}
DEEPEST, WIDEST = 16, 4096  # layers of a network, and units of a layer, at most


class ThreatNetwork(nn.Module):
    """A perceptron from features to the logit of each action's threat."""

    hidden: tuple[int, ...]  # widths; the paper: 100-50 for walls, 500-500-500 for obstacles
    num_actions: int
    activation: str = "relu"

    @nn.compact
    def __call__(self, features: Array) -> Array:
        """(..., F) -> (..., A) logits."""
        x = features
        for width in self.hidden:
            x = ACTIVATIONS[self.activation](nn.Dense(width)(x))
        return nn.Dense(self.num_actions)(x)


class ThreatModel(struct.PyTreeNode):
    """A network with its weights, and the hazards it speaks of."""

    source: Any  # a HazardSource: features and window
    params: Any  # weights of `network`
    scale: Array  # (F,) features are multiplied by this before the network
    shift: Array  # () added to logits up to `knee`; above 0 to err on the safe side
    network: ThreatNetwork = struct.field(pytree_node=False)
    knee: Array = struct.field(default_factory=lambda: jnp.asarray(jnp.inf))  # () logit; far
    # above it, threats are as fitted

    def logits(self, features: Array) -> Array:
        """(..., F) -> (..., A)."""
        scale = jnp.broadcast_to(self.scale, features.shape)
        return self.shifted(jnp.asarray(self.network.apply(self.params, features * scale)))

    def shifted(self, fitted: Array) -> Array:
        """Logits of any shape, as fitted, moved up: by `shift` up to `knee`, then ever less.

        The order of threats stays; from `knee` + 2 `shift` on they are as fitted, since the
        fallback compares large ones.
        """
        fading = jnp.maximum(fitted, 0.5 * (fitted + self.knee) + self.shift)
        return jnp.where(fitted <= self.knee, fitted + self.shift, fading)

    def __call__(self, features: Array) -> Array:
        """(..., F) -> (..., A) threats in [0, 1]."""
        return jax.nn.sigmoid(self.logits(features))
