"""A learned threat function of one kind of hazard, T_n(s, .) for all actions at once."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct
from jax import Array

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"relu": nn.relu, "silu": nn.silu}
DEEPEST, WIDEST = 16, 4096  # greatest number of layers, and of units in a layer
MOST_NODES = 20_000_000  # of a table


class ThreatNetwork(nn.Module):
    """A perceptron that maps features to the logit of each action's threat."""

    hidden: tuple[int, ...]  # widths; in the paper 100-50 for walls, 500-500-500 for obstacles
    num_actions: int  # number of threats: one for each action, or for each plan and action
    activation: str = "relu"  # a name in `ACTIVATIONS`

    @nn.compact
    def __call__(self, features: Array) -> Array:
        """Returns the logits of the threats.

        Args:
            features: (..., F).

        Returns:
            (..., A).
        """
        x = features
        for width in self.hidden:
            x = ACTIVATIONS[self.activation](nn.Dense(width)(x))
        return nn.Dense(self.num_actions)(x)


class ThreatTable(nn.Module):
    """A table of the logits of each action's threat, looked up at the nearest node of a grid."""

    shape: tuple[int, ...]  # number of nodes along each feature
    num_actions: int  # number of threats, as of a `ThreatNetwork`

    @nn.compact
    def __call__(self, features: Array) -> Array:
        """Returns the logits of the threats; nan where a feature is nan or infinite.

        Args:
            features: (..., F).

        Returns:
            (..., A).
        """
        zeros, ones = nn.initializers.zeros, nn.initializers.ones
        low = self.param("low", zeros, (len(self.shape),))  # the grid's first node
        step = self.param("step", ones, (len(self.shape),))  # between neighbouring nodes
        size = (math.prod(self.shape), self.num_actions)
        logits = self.param("logits", zeros, size)
        row = jnp.zeros(features.shape[:-1], jnp.int32)
        for k, count in enumerate(self.shape):
            place = jnp.round((features[..., k] - low[k]) / step[k])
            row = row * count + jnp.clip(place, 0, count - 1).astype(jnp.int32)
        return logits.at[row].get(mode="clip") + 0 * jnp.sum(features, axis=-1, keepdims=True)


class ThreatModel(struct.PyTreeNode):
    """A network or a table, and the kind of hazard whose threats it predicts."""

    source: Any  # the kind of hazard, a `HazardSource`; says what the features are
    params: Any  # of `network`
    scale: Array  # (F,) factors of the features before they enter the network
    shift: Array  # () added to logits up to `knee`; above 0 to err on the safe side
    network: ThreatNetwork | ThreatTable = struct.field(pytree_node=False)
    knee: Array = struct.field(default_factory=lambda: jnp.asarray(jnp.inf))  # () logit above
    # which the shift fades

    def logits(self, features: Array) -> Array:
        """Returns the logits of the threats, shifted.

        Args:
            features: (..., F).

        Returns:
            (..., A).
        """
        scale = jnp.broadcast_to(self.scale, features.shape)
        return self.shifted(jnp.asarray(self.network.apply(self.params, features * scale)))

    def shifted(self, fitted: Array) -> Array:
        """Moves logits up: by `shift` up to `knee`, and by less the further they are above it.

        The order of the threats stays the same. From `knee` + 2 `shift` on, logits are not moved,
        since the choice among inadmissible actions compares large threats.

        Args:
            fitted: logits as fitted, of any shape.
        """
        fading = jnp.maximum(fitted, 0.5 * (fitted + self.knee) + self.shift)
        return jnp.where(fitted <= self.knee, fitted + self.shift, fading)

    def __call__(self, features: Array) -> Array:
        """Returns the threats, in [0, 1].

        Args:
            features: (..., F).

        Returns:
            (..., A).
        """
        return jax.nn.sigmoid(self.logits(features))
