"""Random policies and values: tanh perceptrons on what the Q-networks see (appendix G.3)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import Array

from rp_jax.planning.networks import features
from rp_jax.planning.pmdp import Encoded

CONTROLS = 2  # acceleration and turn, as `kinematics.AgentModel.control` takes them
LOG_STD = -1.0  # of a fresh policy's actions, whose range is [-1, 1]


class Gaussian(NamedTuple):
    """Independent normal distributions of a continuous action's components."""

    mean: Array  # (..., D)
    log_std: Array  # (..., D)

    @property
    def mode(self) -> Array:
        """(..., D) the likeliest action."""
        return self.mean

    def sample(self, key: Array) -> Array:
        """(..., D) one action; the environment cuts it to [-1, 1]."""
        noise = jax.random.normal(key, self.mean.shape, self.mean.dtype)
        return self.mean + jnp.exp(self.log_std) * noise

    def log_prob(self, action: Array) -> Array:
        """(...) log density of actions (..., D)."""
        error = (action - self.mean) * jnp.exp(-self.log_std)
        each = -0.5 * jnp.square(error) - self.log_std - 0.5 * jnp.log(2 * jnp.pi)
        return jnp.sum(each, axis=-1)

    def kl(self, other: "Gaussian") -> Array:
        """(...) KL divergence of `other` from this."""
        spread = jnp.exp(2 * (self.log_std - other.log_std))
        error = jnp.square((self.mean - other.mean) * jnp.exp(-other.log_std))
        each = other.log_std - self.log_std + 0.5 * (spread + error - 1)
        return jnp.sum(each, axis=-1)


class Categorical(NamedTuple):
    """Probabilities of a finite number of actions."""

    logits: Array  # (..., A)

    @property
    def log_probs(self) -> Array:
        """(..., A) normalised."""
        return nn.log_softmax(self.logits)

    @property
    def mode(self) -> Array:
        """(...) int, the likeliest action."""
        return jnp.argmax(self.logits, axis=-1)

    def sample(self, key: Array) -> Array:
        """(...) int, one action."""
        return jax.random.categorical(key, self.logits)

    def log_prob(self, action: Array) -> Array:
        """(...) log probability of actions (...)."""
        return jnp.take_along_axis(self.log_probs, action[..., None], axis=-1)[..., 0]

    def kl(self, other: "Categorical") -> Array:
        """(...) KL divergence of `other` from this."""
        each = jnp.exp(self.log_probs) * (self.log_probs - other.log_probs)
        return jnp.sum(each, axis=-1)


def _perceptron(x: Array, hidden: tuple[int, ...], size: int, name: str) -> Array:
    """(..., size) after tanh layers; small at first, so that a fresh policy is even-handed."""
    for i, width in enumerate(hidden):
        x = nn.tanh(nn.Dense(width, name=f"{name}_{i}")(x))
    last = nn.initializers.variance_scaling(0.01, "fan_in", "truncated_normal")
    return nn.Dense(size, kernel_init=last, name=f"{name}_out")(x)


class GaussianActor(nn.Module):
    """Means from a perceptron, standard deviations alike in all states."""

    num_actions: int  # not used: an action is continuous
    scale: tuple[float, ...]  # of the observation beside the LIDAR
    hidden: tuple[int, ...] = (64, 32)

    @nn.compact
    def __call__(self, seen: Encoded) -> Gaussian:
        """The distribution of actions (..., 2)."""
        mean = _perceptron(features(seen, self.scale), self.hidden, CONTROLS, "mean")
        log_std = self.param("log_std", nn.initializers.constant(LOG_STD), (CONTROLS,))
        return Gaussian(mean, jnp.broadcast_to(log_std, mean.shape))


class CategoricalActor(nn.Module):
    """Probabilities of the environment's discrete actions."""

    num_actions: int
    scale: tuple[float, ...]
    hidden: tuple[int, ...] = (64, 32)

    @nn.compact
    def __call__(self, seen: Encoded) -> Categorical:
        """The distribution of actions (...) int."""
        logits = _perceptron(features(seen, self.scale), self.hidden, self.num_actions, "logits")
        return Categorical(logits)


class Critic(nn.Module):
    """Two perceptrons apart: the value of reward and the value of danger."""

    scale: tuple[float, ...]
    hidden: tuple[int, ...] = (64, 32)

    @nn.compact
    def __call__(self, seen: Encoded, elapsed: Array) -> Array:
        """(..., 2) values, of reward and of danger; `elapsed` (...) is 0 to 1."""
        x = jnp.concatenate([features(seen, self.scale), elapsed[..., None]], axis=-1)
        towers = [_perceptron(x, self.hidden, 1, name) for name in ("reward", "danger")]
        return jnp.concatenate(towers, axis=-1)


ACTORS = {"gaussian": GaussianActor, "categorical": CategoricalActor}
