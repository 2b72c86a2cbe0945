"""Rollouts, advantages and the critic of on-policy learners, for reward and for danger.

Both signals belong to an episode, as limits and tables do: the end by the time limit counts as an
end like any other, and the critic (but not the policy) observes the time.
"""

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
from rp_jax.envs import autoreset, optional, tally
from rp_jax.planning.percept import Encoded, Percept, non_finite
from rp_jax.planning.pmdp import PMDP
from rp_jax.validate import number, one_of

REWARD, DANGER = range(2)  # indices of the two signals


@dataclass(frozen=True)
class ActorCriticConfig:
    """Sizes of the batches, and settings for the advantages and the critic."""

    policy: str = "gaussian"  # or "categorical", over the environment's discrete actions
    num_envs: int = 64  # number of environments side by side
    length: int = 64  # steps of each environment in a batch
    gamma: float = 0.995  # discount of reward
    beta: float = 1.0  # discount of danger in its advantages
    trace: float = 0.95  # lambda of generalised advantage estimation
    critic_rate: float = 1e-3  # learning rate of the critic
    epochs: int = 10  # passes over a batch
    minibatches: int = 16  # minibatches of each pass
    memory: float = 0.8  # factor per batch by which older batches fade when danger is measured

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
        number(f"{name}.memory", self.memory, least=0, most=1)
        if self.steps % self.minibatches:
            raise ValueError(
                f"{name}.minibatches is {self.minibatches}; it must divide the {self.steps} steps "
                "of a batch"
            )

    @property
    def steps(self) -> int:
        """The number of environment steps in a batch."""
        return self.num_envs * self.length


class Recent(NamedTuple):
    """Sums over the batches so far, in which older ones fade."""

    danger: Array  # () danger of the episodes that ended
    episodes: Array  # () number of episodes that ended
    steps: Array  # () number of steps


class Spread(NamedTuple):
    """How large returns are: the mean square of the discounted reward of the episodes so far."""

    squares: Array  # () sum over all steps of the square of the discounted reward so far
    steps: Array  # () number of steps

    @property
    def scale(self) -> Array:
        """The root mean square, (); 1 before anything was earned."""
        return jnp.where(self.squares > 0, jnp.sqrt(self.squares / self.steps), 1.0)


class ActorCriticState(NamedTuple):
    """The state of the learner between two batches."""

    states: Any  # (B,) environment states
    running: tally.Running  # (B,) sums over the episodes under way
    earned: Array  # (B,) their reward so far less penalties, earlier steps discounted more
    spread: Spread  # how large returns are
    recent: Recent  # recent danger
    actor: Any  # weights of the policy
    critic: Any  # weights of the critic
    critic_opt: optax.OptState  # state of the critic's optimiser
    key: Array  # random key of the next batch


class Batch(NamedTuple):
    """A batch of N = length * num_envs steps."""

    encoded: Encoded  # (N,) observations
    elapsed: Array  # (N,) elapsed fraction of an episode's time
    action: Array  # (N,) int or (N, 2) float
    advantage: Array  # (N, 2) advantages of reward and of danger
    target: Array  # (N, 2) values that the critic should have predicted


class ActorCriticMetrics(NamedTuple):
    """Sums over a batch, to be divided by `episodes` or `steps`; counts are int32."""

    steps: Array  # () number of steps
    episodes: Array  # () number of episodes that ended
    score: Array  # () their reward, without any penalty
    danger: Array  # () their danger
    crashes: Array  # () number of these episodes with any danger
    goals: Array  # () number of these episodes that reached the goal
    bad_observations: Array  # () number of observations with a value that is nan or infinite
    bad_rewards: Array  # () number of steps with a reward or danger that is nan or infinite


class _Step(NamedTuple):
    """One step of every environment (B,), before advantages are known."""

    encoded: Encoded
    elapsed: Array
    action: Array
    signal: Array  # (B, 2) reward less the penalty, and danger
    value: Array  # (B, 2) values of the state
    next_value: Array  # (B, 2) values of the state that it led to, terminal ones included
    done: Array


def make_actor(pmdp: PMDP, config: ActorCriticConfig) -> nn.Module:
    """Returns the policy network that the configuration names.

    Args:
        pmdp: the environment.
        config: settings.
    """
    num_actions = optional.num_actions(pmdp.env, pmdp.params)
    return ACTORS[config.policy](num_actions=num_actions, scale=optional.scale(pmdp.env))


def make_critic(pmdp: PMDP) -> nn.Module:
    """Returns the network of both values.

    Args:
        pmdp: the environment.
    """
    return Critic(scale=optional.scale(pmdp.env))


def elapsed_of(states: Any, pmdp: PMDP) -> Array:
    """Returns the elapsed fraction of each episode's time, (B,) in [0, 1].

    Args:
        states: states of the environment, leading axis (B,).
        pmdp: the environment.
    """
    return states.time / pmdp.params.time_limit


def driver(
    network: nn.Module, weights: Any, *, greedy: bool = False
) -> Callable[[Array, Percept], tuple[Array, Array]]:
    """Returns the policy in the form that `evaluation.play_episodes` takes.

    Args:
        network: the policy network.
        weights: its weights.
        greedy: whether to always take the likeliest action instead of drawing one.
    """

    def choose(key: Array, percept: Percept) -> tuple[Array, Array]:
        found: Any = network.apply(weights, percept.encoded)
        action = found.mode if greedy else found.sample(key)
        return action, jnp.zeros(percept.secure.shape, bool)

    return choose


def init(key: Array, pmdp: PMDP, config: ActorCriticConfig) -> ActorCriticState:
    """Starts all environments, a policy and a critic.

    Args:
        key: random key for starts, weights and learning.
        pmdp: the environment.
        config: settings.
    """
    reset_key, actor_key, critic_key, key = jax.random.split(key, 4)
    resets = jax.random.split(reset_key, config.num_envs)
    states = jax.vmap(pmdp.env.reset, (0, None))(resets, pmdp.params)
    encoded = pmdp.perceive(states).encoded
    critic = make_critic(pmdp).init(critic_key, encoded, elapsed_of(states, pmdp))
    nothing = jnp.zeros(config.num_envs)
    zero = jnp.zeros(())
    return ActorCriticState(
        states=states,
        running=tally.Running(nothing, nothing),
        earned=nothing,
        spread=Spread(zero, zero),
        recent=Recent(zero, zero, zero),
        actor=make_actor(pmdp, config).init(actor_key, encoded),
        critic=critic,
        critic_opt=optax.adam(config.critic_rate).init(critic),
        key=key,
    )


def gae(
    signal: Array,
    value: Array,
    next_value: Array,
    done: Array,
    discount: Array,
    trace: float,
) -> Array:
    """Returns generalised advantages of one environment's steps (Schulman et al. 2016).

    After an end nothing follows; after the batch's last step, the value of the state reached does.

    Args:
        signal: (T,) reward or danger of each step.
        value: (T,) value of the state before each step.
        next_value: (T,) value of the state after each step, before any new start.
        done: (T,) bool, the episode ended with the step.
        discount: () discount of the signal.
        trace: lambda.

    Returns:
        (T,).
    """
    chex.assert_equal_shape([signal, value, next_value, done])
    chex.assert_rank(signal, 1)
    errors = signal + discount * jnp.where(done, 0.0, next_value) - value

    def back(ahead: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        error, ended = now
        advantage = error + discount * trace * jnp.where(ended, 0.0, ahead)
        return advantage, advantage

    return jax.lax.scan(back, jnp.zeros_like(errors[0]), (errors, done), reverse=True)[1]


def _advantages(steps: _Step, scale: Array, config: ActorCriticConfig) -> Array:
    """Returns the advantages (T, B, 2) of both signals, reward in units of `scale`."""
    signal = steps.signal / jnp.stack([scale, jnp.ones_like(scale)])[None, None]
    discounts = jnp.asarray([config.gamma, config.beta], steps.value.dtype)
    each_signal = jax.vmap(gae, (1, 1, 1, None, 0, None), 1)
    each_row = jax.vmap(each_signal, (1, 1, 1, 1, None, None), 1)
    return each_row(signal, steps.value, steps.next_value, steps.done, discounts, config.trace)


def collect(
    key: Array, state: ActorCriticState, pmdp: PMDP, config: ActorCriticConfig
) -> tuple[ActorCriticState, Batch, ActorCriticMetrics]:
    """Lets all environments act for `length` steps, without learning.

    `pmdp.penalty` is subtracted from the reward per unit of danger. Values and advantages of reward
    are in units of the returns so far (their root mean square), so that they do not depend on the
    size of a task's rewards.

    Args:
        key: random key for actions and environments.
        state: the learner's state.
        pmdp: the environment.
        config: settings.

    Returns:
        The learner's state with environments and statistics updated, the batch, and its metrics.
    """
    actor, critic = make_actor(pmdp, config), make_critic(pmdp)

    def look(states: Any) -> tuple[Encoded, Array, Array]:
        encoded, elapsed = pmdp.perceive(states).encoded, elapsed_of(states, pmdp)
        return encoded, elapsed, jnp.asarray(critic.apply(state.critic, encoded, elapsed))

    def one(carry, key):
        states, (encoded, elapsed, value), running, earned = carry
        act_key, step_key = jax.random.split(key)
        policy: Any = actor.apply(state.actor, encoded)
        action = policy.sample(act_key)
        keys = jax.random.split(step_key, config.num_envs)
        carried, (_, (_, _, next_value)), outcome = autoreset.step_and_renew(
            pmdp.env, keys, states, action, pmdp.params, look
        )
        reward = outcome.reward - pmdp.penalty * outcome.danger
        signal = jnp.stack([reward, outcome.danger], axis=-1)
        step = _Step(encoded, elapsed, action, signal, value, next_value, outcome.done)
        running, ended = tally.tally(running, outcome)
        earned = config.gamma * earned + reward
        bad_observation, bad_signal = non_finite(encoded, signal)
        metrics = ActorCriticMetrics(
            steps=jnp.asarray(config.num_envs, jnp.int32),
            **ended._asdict(),
            bad_observations=tally.count(bad_observation),
            bad_rewards=tally.count(bad_signal),
        )
        ahead = jnp.where(outcome.done, 0.0, earned)
        return (*carried, running, ahead), (step, metrics, jnp.sum(jnp.square(earned)))

    begin = (state.states, look(state.states), state.running, state.earned)
    keys = jax.random.split(key, config.length)
    (states, _, running, earned), (steps, metrics, squares) = jax.lax.scan(one, begin, keys)
    metrics = jax.tree.map(lambda m: jnp.sum(m, axis=0, dtype=m.dtype), metrics)
    before = state.spread
    spread = Spread(before.squares + jnp.sum(squares), before.steps + config.steps)
    now = Recent(metrics.danger, metrics.episodes, metrics.steps)
    recent = jax.tree.map(lambda old, new: config.memory * old + new, state.recent, now)
    advantage = _advantages(steps, spread.scale, config)
    target = advantage + steps.value
    batch = Batch(steps.encoded, steps.elapsed, steps.action, advantage, target)
    batch = jax.tree.map(lambda a: a.reshape(config.steps, *a.shape[2:]), batch)
    state = state._replace(
        states=states, running=running, earned=earned, spread=spread, recent=recent
    )
    return state, batch, metrics


def update_critic(
    state: ActorCriticState, batch: Batch, pmdp: PMDP, config: ActorCriticConfig
) -> ActorCriticState:
    """Makes one gradient step of both values towards their targets.

    Args:
        state: the learner's state.
        batch: a batch, or part of one.
        pmdp: the environment.
        config: settings.
    """
    critic = make_critic(pmdp)

    def loss(params):
        values = jnp.asarray(critic.apply(params, batch.encoded, batch.elapsed))
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
    """Passes over a batch `epochs` times in random order, with an update for each minibatch.

    Args:
        key: random key for the orders.
        carry: what is updated.
        batch: pytree with leading axis (steps,).
        update: maps what is carried and a minibatch (rows of `batch`) to what is carried on.
        config: settings.

    Returns:
        What is carried after the last update.
    """

    def epoch(carry, key):
        order = jax.random.permutation(key, config.steps).reshape(config.minibatches, -1)

        def one(carry, rows):
            return update(carry, jax.tree.map(lambda a: a[rows], batch)), None

        return jax.lax.scan(one, carry, order)[0], None

    return jax.lax.scan(epoch, carry, jax.random.split(key, config.epochs))[0]
