"""What on-policy learners share: rollouts, advantages of reward and of danger, the critic."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jax import Array

from rp_jax.baselines.policies import ACTORS, Critic
from rp_jax.envs import base
from rp_jax.planning.pmdp import PMDP, Encoded, Percept
from rp_jax.validate import number, one_of

REWARD, DANGER = range(2)  # places of the two signals


@dataclass(frozen=True)
class ActorCriticConfig:
    """Sizes of the batches, and how they are turned into advantages."""

    policy: str = "gaussian"  # or "categorical", over the environment's discrete actions
    num_envs: int = 256
    length: int = 64  # steps of each environment in a batch
    gamma: float = 0.995  # discount of reward
    beta: float = 0.995  # discount of danger in its advantages; limits are of undiscounted danger
    trace: float = 0.95  # lambda of generalised advantage estimation
    critic_rate: float = 1e-3
    epochs: int = 5  # passes over a batch
    minibatches: int = 8  # of each pass
    reward_scale: float = 0.1

    def validate(self, name: str) -> None:
        """Raises ValueError, naming the field after `name`, if a value is out of range."""
        one_of(f"{name}.policy", self.policy, ACTORS)
        number(f"{name}.num_envs", self.num_envs, least=1, integer=True)
        number(f"{name}.length", self.length, least=1, integer=True)
        number(f"{name}.gamma", self.gamma, least=0, most=1)
        number(f"{name}.beta", self.beta, least=0, most=1)
        number(f"{name}.trace", self.trace, least=0, most=1)
        number(f"{name}.critic_rate", self.critic_rate, above=0)
        number(f"{name}.epochs", self.epochs, least=1, integer=True)
        number(f"{name}.minibatches", self.minibatches, least=1, most=self.steps, integer=True)
        number(f"{name}.reward_scale", self.reward_scale, above=0)
        if self.steps % self.minibatches:
            raise ValueError(
                f"{name}.minibatches is {self.minibatches}; it must divide the {self.steps} steps "
                "of a batch"
            )

    @property
    def steps(self) -> int:
        """Agent steps of a batch."""
        return self.num_envs * self.length


class State(NamedTuple):
    """Carried through learning."""

    states: Any  # (B,) environment states
    score: Array  # (B,) reward of the running episodes
    danger: Array  # (B,) likewise
    actor: Any
    critic: Any
    critic_opt: optax.OptState
    key: Array


class Batch(NamedTuple):
    """N = length x num_envs steps."""

    encoded: Encoded  # (N,)
    action: Array  # (N,) or (N, 2)
    advantage: Array  # (N, 2) of reward and of danger
    target: Array  # (N, 2) what the critic should have said


class Metrics(NamedTuple):
    """Sums over a batch; divide by `episodes` or `steps`."""

    steps: Array
    episodes: Array
    score: Array  # of the finished episodes
    danger: Array  # likewise
    crashes: Array  # finished episodes with any danger
    goals: Array


class _Step(NamedTuple):
    """One step of every environment (B,), before advantages are known."""

    encoded: Encoded
    action: Array
    signal: Array  # (B, 2) reward, scaled, and danger
    value: Array  # (B, 2) of the state
    next_value: Array  # (B, 2) of the state it led to, a terminal one included
    terminated: Array
    done: Array


def make_actor(pmdp: PMDP, config: ActorCriticConfig) -> nn.Module:
    """The policy network that the configuration names."""
    num_actions = pmdp.env.num_actions(pmdp.params)
    return ACTORS[config.policy](num_actions=num_actions, scale=pmdp.env.SCALE)


def make_critic(pmdp: PMDP) -> nn.Module:
    """The networks of both values."""
    return Critic(scale=pmdp.env.SCALE)


def driver(
    network: nn.Module, weights: Any, *, greedy: bool = False
) -> Callable[[Array, Percept], tuple[Array, Array]]:
    """The policy as `evaluate.play_episodes` takes it: drawn at random, or always the mode."""

    def choose(key: Array, percept: Percept) -> tuple[Array, Array]:
        found: Any = network.apply(weights, percept.encoded)
        action = found.mode if greedy else found.sample(key)
        return action, jnp.zeros(percept.secure.shape, bool)

    return choose


def init(key: Array, pmdp: PMDP, config: ActorCriticConfig) -> State:
    """Starts all environments, a policy and a critic."""
    reset_key, actor_key, critic_key, key = jax.random.split(key, 4)
    resets = jax.random.split(reset_key, config.num_envs)
    states = jax.vmap(pmdp.env.reset, (0, None))(resets, pmdp.params)
    encoded = pmdp.perceive(states).encoded
    critic = make_critic(pmdp).init(critic_key, encoded)
    nothing = jnp.zeros(config.num_envs, pmdp.x.dtype)
    return State(
        states=states,
        score=nothing,
        danger=nothing,
        actor=make_actor(pmdp, config).init(actor_key, encoded),
        critic=critic,
        critic_opt=optax.adam(config.critic_rate).init(critic),
        key=key,
    )


def gae(
    signal: Array,
    value: Array,
    next_value: Array,
    terminated: Array,
    done: Array,
    discount: Array,
    trace: float,
) -> Array:
    """(T,) generalised advantages (GAE, Schulman et al. 2016) of one environment.

    A true end is worth 0; a time limit, and the batch's last step, the value of the state reached.

    Args:
        signal: (T,) reward or danger of each step.
        value: (T,) of the state before it.
        next_value: (T,) of the state after it, before any fresh start.
        terminated: (T,) bool, truly ended there.
        done: (T,) bool, ended for either reason.
        discount: () of the signal.
        trace: lambda.
    """
    chex.assert_equal_shape([signal, value, next_value, terminated, done])
    chex.assert_rank(signal, 1)
    errors = signal + discount * jnp.where(terminated, 0.0, next_value) - value

    def back(ahead: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        error, ended = now
        advantage = error + discount * trace * jnp.where(ended, 0.0, ahead)
        return advantage, advantage

    return jax.lax.scan(back, jnp.zeros_like(errors[0]), (errors, done), reverse=True)[1]


def _advantages(steps: _Step, config: ActorCriticConfig) -> Array:
    """(T, B, 2) of both signals."""
    discounts = jnp.asarray([config.gamma, config.beta], steps.value.dtype)
    each_signal = jax.vmap(gae, (1, 1, 1, None, None, 0, None), 1)
    each_row = jax.vmap(each_signal, (1, 1, 1, 1, 1, None, None), 1)
    return each_row(
        steps.signal,
        steps.value,
        steps.next_value,
        steps.terminated,
        steps.done,
        discounts,
        config.trace,
    )


def collect(
    key: Array, state: State, pmdp: PMDP, config: ActorCriticConfig
) -> tuple[State, Batch, Metrics]:
    """All environments act for `length` steps; nothing is learned."""
    actor, critic = make_actor(pmdp, config), make_critic(pmdp)

    def look(states: Any) -> tuple[Encoded, Array]:
        encoded = pmdp.perceive(states).encoded
        return encoded, jnp.asarray(critic.apply(state.critic, encoded))

    def one(carry, key):
        states, (encoded, value), score, danger = carry
        act_key, step_key = jax.random.split(key)
        policy: Any = actor.apply(state.actor, encoded)
        action = policy.sample(act_key)
        keys = jax.random.split(step_key, config.num_envs)
        carried, (_, (_, next_value)), outcome = base.step_and_renew(
            pmdp.env, keys, states, action, pmdp.params, look
        )
        signal = jnp.stack([config.reward_scale * outcome.reward, outcome.danger], axis=-1)
        step = _Step(encoded, action, signal, value, next_value, outcome.terminated, outcome.done)
        score, danger = score + outcome.reward, danger + outcome.danger
        metrics = Metrics(
            steps=jnp.asarray(config.num_envs, score.dtype),
            episodes=jnp.sum(outcome.done, dtype=score.dtype),
            score=jnp.sum(jnp.where(outcome.done, score, 0.0)),
            danger=jnp.sum(jnp.where(outcome.done, danger, 0.0)),
            crashes=jnp.sum(outcome.done & (danger > 0), dtype=score.dtype),
            goals=jnp.sum(outcome.goal, dtype=score.dtype),
        )
        running = [jnp.where(outcome.done, 0.0, total) for total in (score, danger)]
        return (*carried, *running), (step, metrics)

    begin = (state.states, look(state.states), state.score, state.danger)
    keys = jax.random.split(key, config.length)
    (states, _, score, danger), (steps, metrics) = jax.lax.scan(one, begin, keys)
    advantage = _advantages(steps, config)
    batch = Batch(steps.encoded, steps.action, advantage, advantage + steps.value)
    batch = jax.tree.map(lambda a: a.reshape(config.steps, *a.shape[2:]), batch)
    metrics = jax.tree.map(lambda m: jnp.sum(m, axis=0), metrics)
    return state._replace(states=states, score=score, danger=danger), batch, metrics


def update_critic(state: State, batch: Batch, pmdp: PMDP, config: ActorCriticConfig) -> State:
    """One gradient step of both values towards their targets."""
    critic = make_critic(pmdp)

    def loss(params):
        values = jnp.asarray(critic.apply(params, batch.encoded))
        return jnp.mean(jnp.sum(jnp.square(values - batch.target), axis=-1))

    grads = jax.grad(loss)(state.critic)
    changes, opt = optax.adam(config.critic_rate).update(grads, state.critic_opt)
    return state._replace(critic=optax.apply_updates(state.critic, changes), critic_opt=opt)


def pass_over(
    key: Array,
    carry: Any,
    batch: Any,
    update: Callable[[Any, Any], Any],
    config: ActorCriticConfig,
) -> Any:
    """`epochs` times all of the batch in a random order, an update for each minibatch.

    Args:
        key: of the orders.
        carry: what is updated.
        batch: pytree with leading axis (steps,).
        update: maps what is carried and a minibatch, a part of `batch`, to what is carried on.
        config: sizes.
    """

    def epoch(carry, key):
        order = jax.random.permutation(key, config.steps).reshape(config.minibatches, -1)

        def one(carry, rows):
            return update(carry, jax.tree.map(lambda a: a[rows], batch)), None

        return jax.lax.scan(one, carry, order)[0], None

    return jax.lax.scan(epoch, carry, jax.random.split(key, config.epochs))[0]
