"""The training loop: acting, threat, replay and learning in one jitted chunk."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import flashbax
import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jax import Array

from rp_jax import shield
from rp_jax.arrays import zeros_like
from rp_jax.envs import autoreset, optional, tally
from rp_jax.planning import dqn
from rp_jax.planning.dqn import DQNConfig, Learner, Transition
from rp_jax.planning.networks import NETWORKS
from rp_jax.planning.nstep import WindowStep, n_step_transition
from rp_jax.planning.percept import Percept, non_finite
from rp_jax.planning.pmdp import PMDP
from rp_jax.validate import finite, none_bad, number, one_of, random_key


@dataclass(frozen=True)
class LoopConfig:
    """Sizes and schedules of the loop.

    Attributes:
        network: "tuned", or "paper".
        learner: settings of double DQN.
        steps: agent steps in all.
        num_envs: environments that step side by side.
        batch: replayed transitions per update.
        updates: gradient steps per step of all environments.
        n_step: rewards in a learning target.
        replay: transitions kept.
        replay_start: transitions kept before learning begins.
        prioritised: replay transitions with large errors more often.
        priority_exponent: exponent of the errors, if prioritised.
        importance: exponent of the importance weights; rises to 1 at the end.
        explore_from: probability of a random admissible action, at first.
        explore_to: its probability after `explore_share` of the steps.
        explore_share: share of the steps over which exploration falls.
    """

    network: str = "tuned"
    learner: DQNConfig = field(default_factory=DQNConfig)
    steps: int = 1_200_000
    num_envs: int = 256
    batch: int = 1024
    updates: int = 1
    n_step: int = 3
    replay: int = 200_000
    replay_start: int = 5_000
    prioritised: bool = False
    priority_exponent: float = 0.6
    importance: float = 0.4
    explore_from: float = 1.0
    explore_to: float = 0.05
    explore_share: float = 0.3

    def validate(self, name: str) -> None:
        """Raises ValueError, naming the field after `name`, if a value is out of range."""
        one_of(f"{name}.network", self.network, NETWORKS)
        self.learner.validate(f"{name}.learner")
        number(f"{name}.num_envs", self.num_envs, least=1, integer=True)
        number(f"{name}.steps", self.steps, least=self.num_envs, integer=True)
        number(f"{name}.batch", self.batch, least=1, integer=True)
        number(f"{name}.updates", self.updates, least=1, integer=True)
        number(f"{name}.n_step", self.n_step, least=1, most=100, integer=True)
        number(f"{name}.replay", self.replay, least=max(self.batch, self.num_envs), integer=True)
        most = self.replay // self.num_envs * self.num_envs
        number(f"{name}.replay_start", self.replay_start, least=1, most=most, integer=True)
        number(f"{name}.priority_exponent", self.priority_exponent, least=0, most=1)
        number(f"{name}.importance", self.importance, least=0, most=1)
        number(f"{name}.explore_from", self.explore_from, least=0, most=1)
        number(f"{name}.explore_to", self.explore_to, least=0, most=1)
        number(f"{name}.explore_share", self.explore_share, above=0, most=1)

    @property
    def iterations(self) -> int:
        """Steps of all environments at once."""
        return -(-self.steps // self.num_envs)

    @property
    def opening(self) -> int:
        """Iterations before anything is kept: one draws the starts, others fill the windows."""
        return self.n_step

    @property
    def filling(self) -> int:
        """Iterations that fill the replay before learning begins."""
        return -(-self.replay_start // self.num_envs)

    @property
    def learning(self) -> int:
        """Iterations of acting and learning, once the replay is filled."""
        return max(1, self.iterations - self.filling - self.opening + 1)

    @property
    def samples_per_step(self) -> float:
        """Replayed transitions per agent step."""
        return self.batch * self.updates / self.num_envs


class LoopMetrics(NamedTuple):
    """Sums over a chunk of iterations, to be divided by `episodes` or `steps`.

    Counts are int32, exact up to `validate.MOST`; score, danger and loss are floats.
    """

    steps: Array
    episodes: Array
    score: Array  # of the finished episodes, without penalty
    danger: Array  # of the finished episodes
    crashes: Array  # finished episodes with any danger
    goals: Array
    insecure: Array  # states without an admissible action
    inadmissible: Array  # actions taken whose threat exceeds x though others' did not
    loss: Array
    bad_observations: Array  # states seen with a number that is nan or infinite
    bad_threats: Array  # states with a threat that is nan or infinite
    bad_rewards: Array  # steps with a reward that is nan or infinite


class LoopState(NamedTuple):
    """All that training carries from one iteration to the next."""

    states: Any  # (B,) environment states
    seen: Percept  # of those states
    running: tally.Running  # (B,) episodes
    window: WindowStep  # (n_step, B), oldest first
    learner: Learner
    replay: Any
    key: Array
    iteration: Array  # () int32; below 0 the windows are not full yet


def make_network(config: LoopConfig, pmdp: PMDP) -> nn.Module:
    """Returns the Q-network that the configuration names.

    Args:
        config: of the loop.
        pmdp: whose actions and observations it is for.
    """
    num_actions = optional.num_actions(pmdp.env, pmdp.params)
    return NETWORKS[config.network](num_actions=num_actions, scale=optional.scale(pmdp.env))


def make_optimiser(config: LoopConfig) -> optax.GradientTransformation:
    """Returns the optimiser of the whole run, Adam.

    Args:
        config: of the loop.
    """
    return dqn.optimiser(config.learner, config.iterations * config.updates)


def make_replay(config: LoopConfig) -> Any:
    """Returns a flashbax buffer of single transitions, uniform or prioritised.

    Args:
        config: of the loop.
    """
    sizes = {
        "max_length": config.replay,
        "min_length": max(config.replay_start, config.num_envs),
        "sample_batch_size": config.batch,
        "add_batches": True,
    }
    if config.prioritised:
        exponent = config.priority_exponent
        return flashbax.make_prioritised_item_buffer(priority_exponent=exponent, **sizes)
    return flashbax.make_item_buffer(**sizes)


def exploration(iteration: Array, config: LoopConfig) -> Array:
    """Returns the probability of exploring, which falls linearly.

    Args:
        iteration: () steps of all environments so far.
        config: of the loop.
    """
    span = max(1.0, config.explore_share * config.iterations)
    done = jnp.clip(iteration / span, 0.0, 1.0)
    return config.explore_from + done * (config.explore_to - config.explore_from)


def _choose(key: Array, values: Array, admissible: Array, epsilon: Array) -> Array:
    """() int32, epsilon-greedy inside the admissible set."""
    explore, pick = jax.random.uniform(key, (2,))
    greedy = shield.masked_argmax(values, admissible)
    random = shield.masked_choice(pick, admissible)
    return jnp.where(explore < epsilon, random, greedy).astype(jnp.int32)


def interact(
    key: Array, state: LoopState, pmdp: PMDP, network: nn.Module, config: LoopConfig
) -> tuple[LoopState, LoopMetrics]:
    """Takes one step of every environment, and learns nothing; the first call draws the starts.

    Args:
        key: of the actions and the environments.
        state: of the loop.
        pmdp: the environment, the threats and the threshold.
        network: of the action values.
        config: of the loop.

    Returns:
        The state with its windows moved on by a step, and the metrics of the step.
    """
    choose_key, step_key = jax.random.split(key)
    batch, starting = config.num_envs, state.iteration < 1 - config.opening
    values = jnp.asarray(network.apply(state.learner.params, state.seen.encoded))
    epsilon = exploration(state.iteration, config)
    keys = jax.random.split(choose_key, batch)
    action = jax.vmap(_choose, (0, 0, 0, None))(keys, values, state.seen.admissible, epsilon)
    carried, (reached, seen), outcome = autoreset.step_and_renew(
        pmdp.env,
        jax.random.split(step_key, batch),
        state.states,
        action,
        pmdp.params,
        pmdp.perceive,
        restart=starting,
        advance=lambda keys, states, action: pmdp.advance(keys, states, action, state.seen),
    )
    insecure = ~seen.secure & ~outcome.terminated
    booked = jax.vmap(optional.booked, (None, 0, 0, 0))
    danger = booked(pmdp.env, state.states, reached, outcome.danger)
    reward = outcome.reward - pmdp.penalty * danger - pmdp.insecure_penalty * insecure
    taken = WindowStep(
        encoded=state.seen.encoded,
        action=action,
        reward=jnp.where(starting, 0.0, reward),
        terminated=outcome.terminated,
        done=outcome.done,
        next_encoded=seen.encoded,
        next_admissible=seen.admissible,
    )
    running, ended = tally.tally(state.running, outcome)
    bad_observation, bad_threat = non_finite(state.seen.encoded, state.seen.threat)
    metrics = LoopMetrics(
        steps=jnp.asarray(batch, jnp.int32),
        **ended._asdict(),
        insecure=tally.count(~state.seen.secure),
        inadmissible=tally.count(_inadmissible(state.seen, action)),
        loss=jnp.zeros((), ended.score.dtype),
        bad_observations=tally.count(bad_observation),
        bad_threats=tally.count(bad_threat),
        bad_rewards=tally.count(~jnp.isfinite(taken.reward)),
    )
    metrics = jax.tree.map(lambda a: jnp.where(starting, jnp.zeros_like(a), a), metrics)
    window = jax.tree.map(
        lambda old, new: jnp.concatenate([old[1:], new[None]]), state.window, taken
    )
    state = state._replace(states=carried[0], seen=carried[1], running=running, window=window)
    return state, metrics


def _inadmissible(seen: Percept, action: Array) -> Array:
    """(B,) bool, checked against the threats themselves and not against the mask."""
    taken = jnp.take_along_axis(seen.threat, action[:, None], axis=-1)[:, 0]
    least = jnp.min(seen.threat, axis=-1)
    x = seen.threshold
    return ~((taken <= x) | ((least > x) & (taken <= least)))


def begin(key: Array, pmdp: PMDP, config: LoopConfig) -> LoopState:
    """Returns a fresh learner, and nothing in the replay; the first iteration draws the starts.

    The environments' states, and what is seen of them, are zeros until then, so that nothing of the
    environment is compiled here.

    Args:
        key: of everything random in training.
        pmdp: the environment, the threats and the threshold.
        config: of the loop.

    Raises:
        ValueError: a setting is out of range.
    """
    config.validate("config")
    random_key("key", key)
    net_key, key = jax.random.split(key)
    batch = config.num_envs
    network, replay = make_network(config, pmdp), make_replay(config)

    def starts(key: Array) -> tuple[Any, Percept]:
        resets = jax.random.split(key, batch)
        states = jax.vmap(pmdp.env.reset, (0, None))(resets, pmdp.params)
        return states, pmdp.perceive(states)

    states, seen = jax.tree.map(zeros_like, jax.eval_shape(starts, key))
    encoded, admissible = seen.encoded, seen.admissible
    zeros = jnp.zeros(batch, seen.threat.dtype)
    false = jnp.zeros(batch, bool)
    taken = WindowStep(
        encoded, jnp.zeros(batch, jnp.int32), zeros, false, false, encoded, admissible
    )
    window = jax.tree.map(lambda a: jnp.stack([a] * config.n_step), taken)
    example = _oldest(window, config)
    return LoopState(
        states=states,
        seen=seen,
        running=tally.Running(zeros, zeros),
        window=window,
        learner=dqn.init(net_key, network, make_optimiser(config), encoded),
        replay=replay.init(jax.tree.map(lambda a: a[0], example)),
        key=key,
        iteration=jnp.asarray(-config.opening, jnp.int32),
    )


def init(key: Array, pmdp: PMDP, config: LoopConfig) -> tuple[LoopState, LoopMetrics]:
    """Returns `begin` with a replay filled by real steps, and the metrics of these.

    Args:
        key: of everything random in training.
        pmdp: the environment, the threats and the threshold.
        config: of the loop.
    """
    state = begin(key, pmdp, config)
    state, opening = chunk(state, pmdp, config, config.opening, updates=0)
    state, metrics = chunk(emptied(state, config), pmdp, config, config.filling, updates=0)
    return state, jax.tree.map(jnp.add, opening, metrics)


def emptied(state: LoopState, config: LoopConfig) -> LoopState:
    """Returns the state with nothing in the replay: what half-filled windows left there is no use.

    Args:
        state: after `config.opening` iterations.
        config: of the loop.
    """
    example = jax.tree.map(lambda a: a[0], _oldest(state.window, config))
    return state._replace(replay=make_replay(config).init(example))


def _oldest(window: WindowStep, config: LoopConfig) -> Transition:
    """(B,) transitions from the oldest steps of the windows."""
    return jax.vmap(n_step_transition, (1, None))(window, config.learner.gamma)


def collect(state: LoopState, pmdp: PMDP, config: LoopConfig) -> tuple[LoopState, LoopMetrics]:
    """Takes one step of every environment, and stores the transitions.

    Args:
        state: of the loop.
        pmdp: the environment, the threats and the threshold.
        config: of the loop.

    Returns:
        The state after, and the metrics of the step.
    """
    key, act_key = jax.random.split(state.key)
    network = make_network(config, pmdp)
    state, metrics = interact(act_key, state, pmdp, network, config)
    stored = make_replay(config).add(state.replay, _oldest(state.window, config))
    return state._replace(replay=stored, key=key, iteration=state.iteration + 1), metrics


def learn(key: Array, state: LoopState, pmdp: PMDP, config: LoopConfig) -> tuple[LoopState, Array]:
    """Updates the network once, from a sample of the replay.

    Args:
        key: of the sample.
        state: of the loop.
        pmdp: the environment, the threats and the threshold.
        config: of the loop.

    Returns:
        The state after, and the loss, ().
    """
    network, replay = make_network(config, pmdp), make_replay(config)
    sample = replay.sample(state.replay, key)
    weights = jnp.ones(config.batch)
    if config.prioritised:
        # Importance weights of prioritised replay, relative to the largest.
        rise = jnp.minimum(state.iteration / config.iterations, 1.0)
        power = config.importance + rise * (1 - config.importance)
        weights = (sample.probabilities + 1e-12) ** -power
        weights = weights / jnp.max(weights)
    learner, loss, errors = dqn.update(
        state.learner, network, make_optimiser(config), sample.experience, weights, config.learner
    )
    stored = state.replay
    if config.prioritised:
        stored = replay.set_priorities(stored, sample.indices, jnp.abs(errors) + 1e-3)
    return state._replace(learner=learner, replay=stored), loss


def chunk(
    state: LoopState,
    pmdp: PMDP,
    config: LoopConfig,
    iterations: int | Array,
    updates: int | Array | None = None,
) -> tuple[LoopState, LoopMetrics]:
    """Collects and learns, several times.

    Where both numbers are traced, one compiled program fills the replay (0 updates) and learns.

    Args:
        state: of the loop.
        pmdp: the environment, the threats and the threshold.
        config: of the loop.
        iterations: steps of every environment.
        updates: per iteration; at most, and by default, `config.updates`.

    Returns:
        The state after, and the sums of the metrics.
    """
    if isinstance(iterations, int):
        number("iterations", iterations, least=1, integer=True)
    updates = config.updates if updates is None else updates

    def iteration(_, carry: tuple[LoopState, Sums]) -> tuple[LoopState, Sums]:
        state, sums = carry
        state, metrics = collect(state, pmdp, config)
        keys = jax.random.split(state.key, 1 + config.updates)

        def update(i: Array, carry: tuple[LoopState, Array]) -> tuple[LoopState, Array]:
            state, loss = learn(keys[1 + i], carry[0], pmdp, config)
            return state, carry[1] + loss

        start = state._replace(key=keys[0]), metrics.loss
        state, loss = jax.lax.fori_loop(0, updates, update, start)
        return state, sums_with(sums, metrics._replace(loss=loss))

    nothing = no_metrics(state.running.score.dtype)
    start = Sums(nothing, jax.tree.map(jnp.zeros_like, nothing))
    state, sums = jax.lax.fori_loop(0, iterations, iteration, (state, start))
    return state, jax.tree.map(jnp.add, sums.total, sums.lost)


class Sums(NamedTuple):
    """Sums over many iterations, whose floats do not drift: what rounding lost is kept beside."""

    total: LoopMetrics
    lost: LoopMetrics  # 0 for counts, which lose nothing


def no_metrics(dtype: Any) -> LoopMetrics:
    """Returns the metrics of no iteration.

    Args:
        dtype: of the sums that are no counts.
    """
    floats = ("score", "danger", "loss")
    of = lambda name: jnp.zeros((), dtype if name in floats else jnp.int32)  # noqa: E731
    return LoopMetrics(*map(of, LoopMetrics._fields))


def sums_with(sums: Sums, metrics: LoopMetrics) -> Sums:
    """Returns sums with those of one more iteration (compensated summation, Kahan 1965).

    A float32 above 1.3e9 moves in steps of 128: without what is kept beside, the returns of the few
    episodes that end in an iteration would be rounded to that.

    Args:
        sums: so far.
        metrics: of the iteration.
    """
    new = jax.tree.map(jnp.add, metrics, sums.lost)
    total = jax.tree.map(jnp.add, sums.total, new)
    lost = jax.tree.map(lambda new, after, before: new - (after - before), new, total, sums.total)
    return Sums(total, lost)


def check(params: Any, metrics: LoopMetrics) -> None:
    """Raises FloatingPointError if something in a chunk was not a finite number, naming it.

    The weights tell of gradients: Adam never forgets one that is not finite.

    Args:
        params: weights of the network.
        metrics: of the chunk.
    """
    none_bad("planning", metrics)
    finite("planning: losses", metrics.loss)
    for leaf in jax.tree.leaves(params):
        finite("planning: weights, after a gradient that was not,", leaf)
