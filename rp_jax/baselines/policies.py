"""Random policies and critics: tanh perceptrons on the Q-networks' observations (appendix G.3)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import Array

from rp_jax.planning.networks import features
from rp_jax.planning.percept import Encoded

CONTROLS = 2  # acceleration and turn, as `dynamics.VehicleModel.control` takes them
LOG_STD = -1.0  # initial log standard deviation of the actions, whose range is [-1, 1]


class Gaussian(NamedTuple):
    """Independent normal distributions of the components of a continuous action."""

    mean: Array  # (..., D) means
    log_std: Array  # (..., D) logarithms of the standard deviations

    @property
    def mode(self) -> Array:
        """The likeliest action, (..., D)."""
        return self.mean

    def sample(self, key: Array) -> Array:
        """Draws an action, (..., D); the environment clips it to [-1, 1].

        Args:
            key: random key.
        """
        noise = jax.random.normal(key, self.mean.shape, self.mean.dtype)
        return self.mean + jnp.exp(self.log_std) * noise

    def log_prob(self, action: Array) -> Array:
        """Returns the log density of actions, (...).

        Args:
            action: (..., D).
        """
        error = (action - self.mean) * jnp.exp(-self.log_std)
        each = -0.5 * jnp.square(error) - self.log_std - 0.5 * jnp.log(2 * jnp.pi)
        return jnp.sum(each, axis=-1)

    def kl(self, other: "Gaussian") -> Array:
        """Returns the KL divergence KL(self || other), (...).

        Args:
            other: the other distribution, of the same shape.
        """
        spread = jnp.exp(2 * (self.log_std - other.log_std))
        error = jnp.square((self.mean - other.mean) * jnp.exp(-other.log_std))
        each = other.log_std - self.log_std + 0.5 * (spread + error - 1)
        return jnp.sum(each, axis=-1)


class Categorical(NamedTuple):
    """A distribution over a finite number of actions."""

    logits: Array  # (..., A) unnormalised log probabilities

    @property
    def log_probs(self) -> Array:
        """The log probabilities, (..., A)."""
        return nn.log_softmax(self.logits)

    @property
    def mode(self) -> Array:
        """The likeliest action, (...) int."""
        return jnp.argmax(self.logits, axis=-1)

    def sample(self, key: Array) -> Array:
        """Draws an action, (...) int.

        Args:
            key: random key.
        """
        return jax.random.categorical(key, self.logits)

    def log_prob(self, action: Array) -> Array:
        """Returns the log probability of actions, (...).

        Args:
            action: (...) int.
        """
        return jnp.take_along_axis(self.log_probs, action[..., None], axis=-1)[..., 0]

    def kl(self, other: "Categorical") -> Array:
        """Returns the KL divergence KL(self || other), (...).

        Args:
            other: the other distribution, of the same shape.
        """
        each = jnp.exp(self.log_probs) * (self.log_probs - other.log_probs)
        return jnp.sum(each, axis=-1)


def _perceptron(x: Array, hidden: tuple[int, ...], size: int, name: str) -> Array:
    """Returns the output (..., size) of tanh layers.

    Its initial values are small, so that a new policy prefers no action.
    """
    for i, width in enumerate(hidden):
        x = nn.tanh(nn.Dense(width, name=f"{name}_{i}")(x))
    last = nn.initializers.variance_scaling(0.01, "fan_in", "truncated_normal")
    return nn.Dense(size, kernel_init=last, name=f"{name}_out")(x)


class GaussianActor(nn.Module):
    """A policy with means from a perceptron, and the same standard deviations in all states."""

    num_actions: int  # not used, since actions are continuous
    scale: tuple[float, ...]  # factors of the observation beside the LIDAR
    hidden: tuple[int, ...] = (64, 32)  # widths of the hidden layers

    @nn.compact
    def __call__(self, seen: Encoded) -> Gaussian:
        """Returns the distribution of actions (..., 2).

        Args:
            seen: observations, leading axes (...).
        """
        mean = _perceptron(features(seen, self.scale), self.hidden, CONTROLS, "mean")
        log_std = self.param("log_std", nn.initializers.constant(LOG_STD), (CONTROLS,))
        return Gaussian(mean, jnp.broadcast_to(log_std, mean.shape))


class CategoricalActor(nn.Module):
    """A policy over the environment's discrete actions."""

    num_actions: int
    scale: tuple[float, ...]  # factors of the observation beside the LIDAR
    hidden: tuple[int, ...] = (64, 32)  # widths of the hidden layers

    @nn.compact
    def __call__(self, seen: Encoded) -> Categorical:
        """Returns the distribution of actions, (...) int.

        Args:
            seen: observations, leading axes (...).
        """
        logits = _perceptron(features(seen, self.scale), self.hidden, self.num_actions, "logits")
        return Categorical(logits)


class Critic(nn.Module):
    """Two separate perceptrons, for the value of reward and the value of danger."""

    scale: tuple[float, ...]  # factors of the observation beside the LIDAR
    hidden: tuple[int, ...] = (64, 32)  # widths of the hidden layers

    @nn.compact
    def __call__(self, seen: Encoded, elapsed: Array) -> Array:
        """Returns the values of reward and of danger.

        Args:
            seen: observations, leading axes (...).
            elapsed: (...) elapsed fraction of the episode's time, in [0, 1].

        Returns:
            (..., 2).
        """
        x = jnp.concatenate([features(seen, self.scale), elapsed[..., None]], axis=-1)
        towers = [_perceptron(x, self.hidden, 1, name) for name in ("reward", "danger")]
        return jnp.concatenate(towers, axis=-1)


ACTORS = {"gaussian": GaussianActor, "categorical": CategoricalActor}
