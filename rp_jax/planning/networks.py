"""Q-networks: the paper's, and a smaller one that learns as well at a tenth of the cost."""

import jax.numpy as jnp
from flax import linen as nn
from jax import Array

from rp_jax.planning.pmdp import Encoded


class TunedNetwork(nn.Module):
    """A perceptron on the pooled LIDAR and the rest of the observation."""

    num_actions: int
    scale: tuple[float, ...]  # (R,) brings the rest of the observation to the order of 1
    hidden: tuple[int, ...] = (128, 64)

    @nn.compact
    def __call__(self, seen: Encoded) -> Array:
        """(..., A) action values."""
        scan = 1.0 - seen.scan.astype(seen.rest.dtype) / 255
        scale = jnp.broadcast_to(jnp.asarray(self.scale, seen.rest.dtype), seen.rest.shape)
        x = jnp.concatenate([scan, seen.rest * scale], axis=-1)
        for width in self.hidden:
            x = nn.silu(nn.Dense(width)(x))
        return nn.Dense(self.num_actions)(x)


class PaperNetwork(nn.Module):
    """Appendix G.1: convolution (3 channels, kernel 6) and max pooling (8) of the LIDAR, then
    50-20 tanh units."""

    num_actions: int
    scale: tuple[float, ...]  # not used: the paper feeds raw values

    @nn.compact
    def __call__(self, seen: Encoded) -> Array:
        """(..., A) action values."""
        scan = seen.scan.astype(seen.rest.dtype) / 255
        scan = jnp.where(scan == 1.0, 0.0, scan)  # the paper's scans say 0 where nothing is seen
        x = nn.relu(nn.Conv(3, (6,), padding="VALID")(scan[..., None]))
        x = nn.max_pool(x, (8,), (8,))
        x = jnp.concatenate([x.reshape(*x.shape[:-2], -1), seen.rest], axis=-1)
        for width in (50, 20):
            x = nn.tanh(nn.Dense(width)(x))
        return nn.Dense(self.num_actions)(x)


NETWORKS = {"tuned": TunedNetwork, "paper": PaperNetwork}
POOLS = {"tuned": 8, "paper": 1}  # LIDAR bins pooled before the network
