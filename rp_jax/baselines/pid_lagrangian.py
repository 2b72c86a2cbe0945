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

FAR = 10.0  # beyond the limit, in units of it
SMALL = 1e-6  # keeps quotients finite: the least that a limit counts as


@dataclass(frozen=True)
class PIDConfig:
    """Hyperparameters of the learner."""

    # What comes long after an action is noise in the danger of it, and a penalty amplifies it.
    rollout: ActorCriticConfig = field(default_factory=lambda: ActorCriticConfig(beta=0.9))
    learning_rate: float = 3e-4  # of the policy
    clip: float = 0.2  # of the probability ratio
    divergence: float = 0.01  # from the policy that acted, at which a batch moves it no more
    proportional: float = 0.1  # gains, of danger in units of its limit
    integral: float = 0.01
    derivative: float = 0.1

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
    """What the penalty remembers."""

    integral: Array  # () sum of what was beyond the limit, never below 0
    danger: Array  # () of an episode, as measured last


class State(NamedTuple):
    """Carried through learning."""

    learner: actor_critic.State
    actor_opt: optax.OptState
    controller: Controller


class Metrics(NamedTuple):
    """Of one step."""

    rollout: actor_critic.Metrics
    penalty: Array  # () lambda


def control(
    controller: Controller, danger: Array, limit: Array, config: PIDConfig
) -> tuple[Controller, Array]:
    """The penalty lambda from the danger of the last episodes (Stooke et al., Algorithm 2).

    Danger counts in units of the limit, since it can fall below it by one of them alone; and no
    more than `FAR` of them, or what a fresh policy does would be held against it for ever.
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
    """() the clipped surrogate of PPO (Schulman et al. 2017), to be maximised.

    Args:
        params: of the policy.
        network: of the policy.
        batch: (N,) steps.
        gain: (N,) advantages, penalty included.
        before: (N,) log probabilities under the policy that acted.
        clip: how far the ratio may move the objective.
    """
    policy: Any = network.apply(params, batch.encoded)
    ratio = jnp.exp(policy.log_prob(batch.action) - before)
    return jnp.mean(jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - clip, 1 + clip) * gain))


def moved(params: Any, network: nn.Module, batch: Batch, before: Array) -> Array:
    """() KL divergence from the policy that acted, estimated from its actions: E[r - 1 - log r].

    Arguments are those of `objective`.
    """
    policy: Any = network.apply(params, batch.encoded)
    log_ratio = policy.log_prob(batch.action) - before
    return jnp.mean(jnp.expm1(log_ratio) - log_ratio)


def penalised(advantage: Array, penalty: Array) -> Array:
    """(N,) A_r - lambda A_d of advantages (N, 2), standardised once they are one."""
    gain = advantage[:, REWARD] - penalty * advantage[:, DANGER]
    return (gain - jnp.mean(gain)) / (jnp.std(gain) + SMALL)


def init(key: Array, pmdp: PMDP, config: PIDConfig) -> State:
    """Starts all environments, a policy and a critic; the penalty is 0."""
    learner = actor_critic.init(key, pmdp, config.rollout)
    nothing = jnp.zeros_like(pmdp.x)
    opt = optax.adam(config.learning_rate).init(learner.actor)
    return State(learner, opt, Controller(nothing, nothing))


def step(state: State, pmdp: PMDP, limit: Array, config: PIDConfig) -> tuple[State, Metrics]:
    """Collects a batch, adapts the penalty, then improves policy and critic.

    Arguments are those of `cpo.step`.
    """
    rollout = config.rollout
    key, collect_key, fit_key = jax.random.split(state.learner.key, 3)
    learner, batch, metrics = actor_critic.collect(collect_key, state.learner, pmdp, rollout)
    # Where no episode has ended, nothing is known of them; the first ones are no rise.
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
    return State(learner, opt, controller), Metrics(metrics, penalty)
