"""A learned threat function of one kind of hazard, T_n(s, .) for all actions at once."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct
from jax import Array

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"relu": nn.relu, "silu": nn.silu}
DEEPEST, WIDEST = 16, 4096  # greatest number of layers, and of units in a layer


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


class ThreatModel(struct.PyTreeNode):
    """A network with its weights, and the kind of hazard whose threats it predicts."""

    source: Any  # the kind of hazard, a `HazardSource`; says what the features are
    params: Any  # weights of `network`
    scale: Array  # (F,) factors of the features before they enter the network
    shift: Array  # () added to logits up to `knee`; above 0 to err on the safe side
    network: ThreatNetwork = struct.field(pytree_node=False)
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
