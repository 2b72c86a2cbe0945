"""Masked Double DQN: Algorithm 4 with a network for Q."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jax import Array

from rp_jax import shield
from rp_jax.planning.percept import Encoded
from rp_jax.validate import number


class Transition(NamedTuple):
    """An item of the replay buffer: n steps from a state, and the state that they led to."""

    encoded: Encoded  # observation of the first state
    action: Array  # () int32, first action
    reward: Array  # () discounted sum of the rewards of the n steps
    discount: Array  # () gamma^n; 0 where a terminal state was reached
    next_encoded: Encoded  # observation of the last state
    next_admissible: Array  # (A,) bool, the admissible actions of the last state


@dataclass(frozen=True)
class DQNConfig:
    """Hyperparameters of the learner.

    Attributes:
        gamma: discount of reward.
        learning_rate: Adam's learning rate.
        epsilon: Adam's epsilon.
        anneal: let the learning rate fall to a tenth.
        polyak: step size of the target network; 0: copy it every `period` updates.
        period: updates between copies of the target network.
        reward_scale: factor of the rewards.
        masked_target: maximum over admissible actions; False: over all actions.
    """

    gamma: float = 0.95
    learning_rate: float = 3e-3
    epsilon: float = 1e-8
    anneal: bool = True
    polyak: float = 0.01
    period: int = 1000
    reward_scale: float = 0.1
    masked_target: bool = True

    def validate(self, name: str) -> None:
        """Raises ValueError, naming the field after `name`, if a value is out of range."""
        number(f"{name}.gamma", self.gamma, least=0, most=1)
        number(f"{name}.learning_rate", self.learning_rate, above=0)
        number(f"{name}.epsilon", self.epsilon, above=0)
        number(f"{name}.polyak", self.polyak, least=0, most=1)
        number(f"{name}.period", self.period, least=1, integer=True)
        number(f"{name}.reward_scale", self.reward_scale, above=0)


class Learner(NamedTuple):
    """The state of the learner between two updates."""

    params: Any  # weights of the Q-network
    target: Any  # weights of the target network
    opt_state: optax.OptState  # state of the optimiser
    updates: Array  # () int32, number of updates made


def double_q_target(
    reward: Array, discount: Array, online: Array, target: Array, admissible: Array
) -> Array:
    """Returns the target of Double Q-learning inside the admissible set (Algorithm 4).

    Lines 5 to 10: r + gamma Q'(s', argmax_{a' in A(s')} Q(s', a')).

    Args:
        reward: () reward r of the step or steps to s'.
        discount: () gamma to the power of their number; 0 where s' is terminal.
        online: (A,) Q(s', .), which chooses the action.
        target: (A,) Q'(s', .), which gives its value.
        admissible: (A,) bool, the admissible actions A(s').

    Returns:
        ().
    """
    chex.assert_rank([reward, discount, online, target, admissible], [0, 0, 1, 1, 1])
    return reward + discount * target[shield.masked_argmax(online, admissible)]


def optimiser(config: DQNConfig, updates: int) -> optax.GradientTransformation:
    """Returns Adam, whose learning rate may fall over the updates.

    Args:
        config: hyperparameters; with `anneal` the rate falls to a tenth along a cosine.
        updates: number of updates over which it falls.
    """
    rate = config.learning_rate
    schedule = optax.cosine_decay_schedule(rate, updates, alpha=0.1)
    return optax.adam(schedule if config.anneal else rate, eps=config.epsilon)


def init(
    key: Array, network: nn.Module, transform: optax.GradientTransformation, encoded: Encoded
) -> Learner:
    """Returns a new learner, whose target network equals its Q-network.

    Args:
        key: random key for the weights.
        network: the Q-network.
        transform: the optimiser.
        encoded: any observation, for the shapes.
    """
    params = network.init(key, encoded)
    target = jax.tree.map(jnp.copy, params)
    return Learner(params, target, transform.init(params), jnp.asarray(0, jnp.int32))


def update(
    learner: Learner,
    network: nn.Module,
    transform: optax.GradientTransformation,
    batch: Transition,
    weights: Array,
    config: DQNConfig,
) -> tuple[Learner, Array, Array]:
    """Makes one gradient step.

    Args:
        learner: the learner before the step.
        network: the Q-network.
        transform: the optimiser, from `optimiser`.
        batch: transitions, leading axis (B,).
        weights: (B,) weights of the transitions; 1 unless the replay is prioritised.
        config: hyperparameters.

    Returns:
        The learner after the step, the mean Huber loss (), and the temporal-difference errors (B,).
    """
    online = jnp.asarray(network.apply(learner.params, batch.next_encoded))
    target = jnp.asarray(network.apply(learner.target, batch.next_encoded))
    admissible = batch.next_admissible
    if not config.masked_target:
        admissible = jnp.ones_like(admissible)
    reward = batch.reward * config.reward_scale
    goal = jax.vmap(double_q_target)(reward, batch.discount, online, target, admissible)

    def loss(params):
        values = jnp.asarray(network.apply(params, batch.encoded))
        chosen = jnp.take_along_axis(values, batch.action[:, None], axis=-1)[:, 0]
        return jnp.mean(weights * optax.huber_loss(chosen, goal)), chosen - goal

    (value, errors), grads = jax.value_and_grad(loss, has_aux=True)(learner.params)
    updates, opt_state = transform.update(grads, learner.opt_state, learner.params)
    params = optax.apply_updates(learner.params, updates)
    count = learner.updates + 1
    if config.polyak > 0:
        moved = optax.incremental_update(params, learner.target, config.polyak)
    else:
        moved = optax.periodic_update(params, learner.target, count, config.period)
    return Learner(params, moved, opt_state, count), value, errors
