"""PPO with a penalty that a PID controller adapts (Stooke et al. 2020)."""

import functools
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jax import Array

from rp_jax.baselines import actor_critic
from rp_jax.baselines.actor_critic import DANGER, REWARD, ActorCriticConfig, Batch
from rp_jax.planning.pmdp import PMDP
from rp_jax.validate import number

FAR = 10.0  # greatest excess of danger that counts, in units of the limit
SMALL = 1e-6  # least denominator, so that quotients stay finite


@dataclass(frozen=True)
class PIDConfig:
    """Hyperparameters of the learner."""

    # Danger long after an action is mostly noise, which a penalty amplifies: so it is discounted.
    rollout: ActorCriticConfig = field(default_factory=lambda: ActorCriticConfig(beta=0.9))
    learning_rate: float = 3e-4  # learning rate of the policy
    clip: float = 0.2  # clip range of the probability ratio
    divergence: float = 0.01  # KL divergence from the acting policy at which updates stop
    proportional: float = 0.1  # gain of the excess of danger, in units of its limit
    integral: float = 0.01  # gain of the excess summed over batches
    derivative: float = 0.1  # gain of the rise of danger since the batch before

    def validate(self, name: str) -> None:
        """Raises ValueError, naming the field after `name`, if a value is out of range."""
        self.rollout.validate(f"{name}.rollout")
        number(f"{name}.learning_rate", self.learning_rate, above=0)
        number(f"{name}.clip", self.clip, above=0, most=1)
        number(f"{name}.divergence", self.divergence, above=0)
        number(f"{name}.proportional", self.proportional, least=0)
        number(f"{name}.integral", self.integral, least=0)
        number(f"{name}.derivative", self.derivative, least=0)


class Controller(NamedTuple):
    """The memory of the penalty's controller."""

    integral: Array  # () sum of danger's excess over the limit, in its units, never below 0
    danger: Array  # () danger of an episode, as measured last


class PIDState(NamedTuple):
    """The state of the learner between two batches."""

    learner: actor_critic.ActorCriticState  # environments, policy and critic
    actor_opt: optax.OptState  # state of the policy's optimiser
    controller: Controller  # memory of the penalty's controller


class PIDMetrics(NamedTuple):
    """PIDMetrics of one step of the learner."""

    rollout: actor_critic.ActorCriticMetrics
    penalty: Array  # () lambda, the penalty per unit of danger


def control(
    controller: Controller, danger: Array, limit: Array, config: PIDConfig
) -> tuple[Controller, Array]:
    """Returns the penalty lambda for the danger of the last episodes (Stooke et al., Algorithm 2).

    Danger is measured in units of the limit, since it can fall below the limit by at most one of
    them. At most `FAR` units count, since otherwise the danger of an untrained policy would raise
    the penalty for far too long.

    Args:
        controller: the controller's memory.
        danger: () danger of an episode.
        limit: () greatest danger wanted.
        config: hyperparameters.

    Returns:
        The controller's new memory, and lambda ().
    """
    unit = jnp.maximum(limit, SMALL)
    error = jnp.clip((danger - limit) / unit, -1.0, FAR)
    integral = jnp.maximum(controller.integral + error, 0.0)
    rise = jnp.clip((danger - controller.danger) / unit, 0.0, FAR)
    penalty = config.proportional * error + config.integral * integral + config.derivative * rise
    return Controller(integral, danger), jnp.maximum(penalty, 0.0)


def objective(
    params: Any, network: nn.Module, batch: Batch, gain: Array, before: Array, clip: float
) -> Array:
    """Returns the clipped surrogate objective of PPO (Schulman et al. 2017), to be maximised.

    Args:
        params: weights of the policy.
        network: the policy network.
        batch: (N,) steps.
        gain: (N,) advantages, penalty included.
        before: (N,) log probabilities of the actions under the policy that acted.
        clip: clip range of the probability ratio.

    Returns:
        ().
    """
    policy: Any = network.apply(params, batch.encoded)
    ratio = jnp.exp(policy.log_prob(batch.action) - before)
    return jnp.mean(jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - clip, 1 + clip) * gain))


def moved(params: Any, network: nn.Module, batch: Batch, before: Array) -> Array:
    """Estimates the KL divergence from the policy that acted, by E[r - 1 - log r] over its actions.

    Args:
        params: weights of the policy.
        network: the policy network.
        batch: (N,) steps.
        before: (N,) log probabilities of the actions under the policy that acted.

    Returns:
        ().
    """
    policy: Any = network.apply(params, batch.encoded)
    log_ratio = policy.log_prob(batch.action) - before
    return jnp.mean(jnp.expm1(log_ratio) - log_ratio)


def penalised(advantage: Array, penalty: Array) -> Array:
    """Returns A_r - lambda A_d, standardised to mean 0 and standard deviation 1.

    Args:
        advantage: (N, 2) advantages of reward and of danger.
        penalty: () lambda.

    Returns:
        (N,).
    """
    gain = advantage[:, REWARD] - penalty * advantage[:, DANGER]
    return (gain - jnp.mean(gain)) / (jnp.std(gain) + SMALL)


def init(key: Array, pmdp: PMDP, config: PIDConfig) -> PIDState:
    """Starts all environments, a policy and a critic; the penalty starts at 0.

    Args:
        key: random key for starts, weights and learning.
        pmdp: the environment.
        config: hyperparameters.
    """
    learner = actor_critic.init(key, pmdp, config.rollout)
    nothing = jnp.zeros(())
    opt = optax.adam(config.learning_rate).init(learner.actor)
    return PIDState(learner, opt, Controller(nothing, nothing))


def step(
    state: PIDState, pmdp: PMDP, limit: Array, config: PIDConfig
) -> tuple[PIDState, PIDMetrics]:
    """Collects a batch, adapts the penalty, then improves policy and critic.

    Args:
        state: the learner's state.
        pmdp: the environment, not shielded. Its penalty is subtracted from the rewards.
        limit: () greatest expected danger of an episode, not discounted; may be swept by `vmap`.
        config: hyperparameters.

    Returns:
        The learner's state after the step, and metrics.
    """
    rollout = config.rollout
    key, collect_key, fit_key = jax.random.split(state.learner.key, 3)
    learner, batch, metrics = actor_critic.collect(collect_key, state.learner, pmdp, rollout)
    # Before any episode has ended, their danger is unknown; the first ones do not count as a rise.
    recent, known = learner.recent, state.learner.recent.episodes > 0
    danger = jnp.where(recent.episodes > 0, recent.danger / recent.episodes, limit)
    before = jnp.where(known, state.controller.danger, danger)
    controller, penalty = control(
        Controller(state.controller.integral, before), danger, limit, config
    )
    network = actor_critic.make_actor(pmdp, rollout)
    acted: Any = network.apply(learner.actor, batch.encoded)
    items = (batch, penalised(batch.advantage, penalty), acted.log_prob(batch.action))
    transform = optax.adam(config.learning_rate)

    def update(carry, items):
        learner, opt, near = carry
        part, gain, before = items
        near &= moved(learner.actor, network, part, before) <= config.divergence
        grads = jax.grad(objective)(learner.actor, network, part, gain, before, config.clip)
        changes, new_opt = transform.update(jax.tree.map(jnp.negative, grads), opt)
        found = (optax.apply_updates(learner.actor, changes), new_opt)
        kept = (learner.actor, opt)
        actor, opt = jax.tree.map(functools.partial(jnp.where, near), found, kept)
        learner = learner._replace(actor=actor)
        return actor_critic.update_critic(learner, part, pmdp, rollout), opt, near

    carry = (learner._replace(key=key), state.actor_opt, jnp.asarray(True))
    learner, opt, _ = actor_critic.pass_over(fit_key, carry, items, update, rollout)
    return PIDState(learner, opt, controller), PIDMetrics(metrics, penalty)
