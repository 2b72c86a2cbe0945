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
from rp_jax.planning.pmdp import Encoded
from rp_jax.validate import number


class Transition(NamedTuple):
    """One item of the replay: n steps from a state, and what is admissible where they led."""

    encoded: Encoded
    action: Array  # () int32
    reward: Array  # () discounted sum over the n steps
    discount: Array  # () gamma^n, 0 after a true end
    next_encoded: Encoded
    next_admissible: Array  # (W,) uint32, `shield.to_bits`


@dataclass(frozen=True)
class DQNConfig:
    """Hyperparameters of the learner."""

    gamma: float = 0.95
    learning_rate: float = 3e-3
    epsilon: float = 1e-8  # Adam's
    anneal: bool = True  # learning rate falls to a tenth
    polyak: float = 0.01  # 0: copy every `period`
    period: int = 1000  # updates between copies
    reward_scale: float = 0.1
    masked_target: bool = True  # maximum over admissible actions; False: over all

    def validate(self, name: str) -> None:
        """Raises ValueError, naming the field after `name`, if a value is out of range."""
        number(f"{name}.gamma", self.gamma, least=0, most=1)
        number(f"{name}.learning_rate", self.learning_rate, above=0)
        number(f"{name}.epsilon", self.epsilon, above=0)
        number(f"{name}.polyak", self.polyak, least=0, most=1)
        number(f"{name}.period", self.period, least=1, integer=True)
        number(f"{name}.reward_scale", self.reward_scale, above=0)


class Learner(NamedTuple):
    """Carried through learning."""

    params: Any
    target: Any
    opt_state: optax.OptState
    updates: Array  # () int32


def double_q_target(
    reward: Array, discount: Array, online: Array, target: Array, admissible: Array
) -> Array:
    """() r + gamma Q'(s', argmax_{a' in A(s')} Q(s', a')): Algorithm 4, lines 5 to 10.

    Args:
        reward: () of the step(s) to s'.
        discount: () 0 where s' is terminal.
        online: (A,) Q(s', .) that chooses.
        target: (A,) Q'(s', .) that values.
        admissible: (A,) bool; greedy-eta alone where s' is not secure.
    """
    chex.assert_rank([reward, discount, online, target, admissible], [0, 0, 1, 1, 1])
    return reward + discount * target[shield.masked_argmax(online, admissible)]


def optimiser(config: DQNConfig, updates: int) -> optax.GradientTransformation:
    """Adam, whose rate may fall over so many updates."""
    rate = config.learning_rate
    schedule = optax.cosine_decay_schedule(rate, updates, alpha=0.1)
    return optax.adam(schedule if config.anneal else rate, eps=config.epsilon)


def init(
    key: Array, network: nn.Module, transform: optax.GradientTransformation, encoded: Encoded
) -> Learner:
    """A fresh learner; `encoded` is any example."""
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
    """One gradient step.

    Args:
        learner: before the step.
        network: of the action values.
        transform: from `optimiser`.
        batch: transitions with leading axis (B,).
        weights: (B,) of the samples, 1 unless the replay is prioritised.
        config: hyperparameters.

    Returns:
        (learner, loss, errors): the mean Huber loss and the temporal-difference errors (B,).
    """
    online = jnp.asarray(network.apply(learner.params, batch.next_encoded))
    target = jnp.asarray(network.apply(learner.target, batch.next_encoded))
    admissible = jax.vmap(shield.from_bits, (0, None))(batch.next_admissible, online.shape[-1])
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
