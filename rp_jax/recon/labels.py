"""Threats of one state in a sub-R-MDP: T_n(s, a) of equation 3, for all actions at once.

Both estimators take any start state and return the same thing. The danger is the event's first
occurrence: T_n(s, a) = E[beta^K 1{K <= horizon}], K the first step at which hazard n is hit (0 if
it is hit already), under the action a first and the baseline policy eta^(o) after it.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.hazards import SubRMDP
from rp_jax.kinematics import ControlDistribution, Plans
from rp_jax.validate import finite


class Labels(struct.PyTreeNode):
    """Threats and their standard errors."""

    threat: Array  # (A,); (K * A,) where the baseline is K plans, plans counting slower
    stderr: Array  # alike, 0 where exact, and where all sampled paths agree


MOST_LEAVES = 200_000  # of a tree that is enumerated

# (key, agent, hazard, sub) -> Labels, unbatched.
Estimator = Callable[[Array, Any, Any, SubRMDP], Labels]


def exact_threat(key: Array, agent: Any, hazard: Any, sub: SubRMDP) -> Labels:
    """Enumerates all baseline controls; exact for hazards that stay where they are.

    The tree has `leaves(sub)` leaves. `key` is not used.
    """
    del key
    source, model = sub.source, sub.agent
    assert isinstance(model.baseline, ControlDistribution)
    controls, probabilities = model.baseline.controls, model.baseline.probabilities
    any_control = jax.tree.map(lambda table: table[0], controls)

    def value(agent: Any, k: int) -> Array:
        """E[beta^(K - k)] from the agent's state at step k, for all steps up to the horizon."""
        hit = source.hits(agent, hazard)
        if k == source.horizon:
            later = jnp.zeros_like(sub.beta)
        elif k == source.horizon - 1 and model.delayed:
            later = value(model.step(agent, any_control), k + 1)
        else:
            branch = jax.vmap(lambda control: value(model.step(agent, control), k + 1))
            later = jnp.sum(probabilities * branch(controls))
        return jnp.where(hit, 1.0, sub.beta * later)

    def first(action: Any) -> Array:
        return value(model.step(agent, action), 1)

    threat = jax.vmap(first)(model.actions) * sub.beta
    threat = jnp.where(source.hits(agent, hazard), 1.0, threat)
    return Labels(threat=threat, stderr=jnp.zeros_like(threat))


def monte_carlo_threat(
    key: Array, agent: Any, hazard: Any, sub: SubRMDP, paths: int = 256
) -> Labels:
    """Averages `paths` rollouts; for any hazard.

    The same draws serve all actions (common random numbers), and a hazard that does not heed
    the agent is moved once for all of them.
    """
    source, model = sub.source, sub.agent
    assert isinstance(model.baseline, ControlDistribution)
    ours, theirs = jax.random.split(key)
    controls = model.baseline.sample(ours, (source.horizon - 1, paths))
    noise = source.draw(theirs, (source.horizon, paths))

    def rollout(action: Any, controls: Any, noise: Any) -> Array:
        def control(k: int, us: Any) -> Any:
            return action if k == 0 else jax.tree.map(lambda c: c[k - 1], controls)

        return _first_hit(agent, hazard, sub, control, noise)

    over_actions = jax.vmap(rollout, (0, None, None))
    values = jax.vmap(over_actions, (None, 1, 1))(model.actions, controls, noise)  # (paths, A)
    return _average(values)


def plan_threat(key: Array, agent: Any, hazard: Any, sub: SubRMDP, paths: int = 256) -> Labels:
    """T_n^{eta_k}(s, a) of every plan k and action a: `paths` rollouts of the hazard.

    The agent's ways are deterministic, and the hazard's the same for all of them.
    """
    source, model = sub.source, sub.agent
    assert isinstance(model.baseline, Plans)
    noise = source.draw(key, (source.horizon, paths))

    def rollout(plan: Plans, action: Any, noise: Any) -> Array:
        def control(k: int, us: Any) -> Any:
            return action if k == 0 else plan.control(k - 1, us.speed)

        return _first_hit(agent, hazard, sub, control, noise)

    plans = model.baseline
    over_actions = jax.vmap(rollout, (None, 0, None))
    over_plans = jax.vmap(over_actions, (plans.axes, None, None))
    values = jax.vmap(over_plans, (None, None, 1))(plans, model.actions, noise)  # (paths, K, A)
    return _average(values.reshape(paths, -1))


def _first_hit(
    agent: Any, hazard: Any, sub: SubRMDP, control: Callable[[int, Any], Any], noise: Any
) -> Array:
    """() beta^K 1{K <= horizon} of one path.

    Args:
        agent: its first state.
        hazard: its first state.
        sub: the sub-R-MDP.
        control: from the step and the agent's state to its command.
        noise: (horizon, ...) the hazard's random numbers.
    """
    source, us, other = sub.source, agent, hazard
    hit = source.hits(us, other)
    value = jnp.where(hit, 1.0, 0.0)
    weight = jnp.ones_like(value)
    for k in range(source.horizon):
        before, us = us, sub.agent.step(us, control(k, us))
        other = source.step(other, before, jax.tree.map(lambda n, k=k: n[k], noise))
        weight = weight * sub.beta
        now = source.hits(us, other) & ~hit
        value = jnp.where(now, weight, value)
        hit = hit | now
    return value


def _average(values: Array) -> Labels:
    """Mean over paths (paths, ...) and its standard error."""
    paths = values.shape[0]
    spread = jnp.std(values, axis=0, ddof=1) if paths > 1 else jnp.ones(values.shape[1])
    return Labels(threat=jnp.mean(values, axis=0), stderr=spread / jnp.sqrt(paths))


def leaves(sub: SubRMDP) -> int:
    """Size of the tree that `exact_threat` enumerates.

    A * K^(horizon - 1) for A actions and K baseline controls, and a power less where controls act
    one step later.
    """
    assert isinstance(sub.agent.baseline, ControlDistribution)
    controls = len(sub.agent.baseline.probabilities)
    power = max(0, sub.source.horizon - 1 - sub.agent.delayed)
    return len(sub.agent.actions.acceleration) * controls**power


def best_estimator(sub: SubRMDP, paths: int) -> Estimator:
    """Exact enumeration where the hazard stays put and the tree is small enough.

    Elsewhere Monte Carlo with `paths` rollouts.
    """
    if isinstance(sub.agent.baseline, Plans):
        return _sampled(plan_threat, paths)
    if sub.source.static and leaves(sub) <= MOST_LEAVES:
        return exact_threat
    return _sampled(monte_carlo_threat, paths)


@functools.cache
def _sampled(estimator: Callable[..., Labels], paths: int) -> Estimator:
    """One object per number of paths, so that `label` compiles once for it."""
    return functools.partial(estimator, paths=paths)


@functools.partial(jax.jit, static_argnames=("estimator", "batch"))
def _label(key, agent, hazard, sub, estimator, batch):
    count = jax.tree.leaves(agent)[0].shape[0]
    keys = jax.random.split(key, count)
    one = lambda row: estimator(*row, sub)  # noqa: E731
    return jax.lax.map(one, (keys, agent, hazard), batch_size=batch)


def label(
    key: Array,
    agent: Any,
    hazard: Any,
    sub: SubRMDP,
    estimator: Estimator,
    *,
    batch: int = 32,
    rows: int = 8192,
    on_progress: Callable[[int, int], None] | None = None,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> Labels:
    """Labels many states, leading axis (n,), `rows` to a call and `batch` side by side.

    Args:
        key: each row gets its own from it.
        agent: (n, ...) agent states.
        hazard: (n, ...) hazard states.
        sub: the sub-R-MDP.
        estimator: `exact_threat` or a `monte_carlo_threat`.
        batch: rows simulated at once; bounds the memory.
        rows: rows between two reports of progress.
        on_progress: called with (rows done, n).
        checkpoints: of these labels.

    Raises:
        FloatingPointError: a label is not a finite number.
    """
    count = jax.tree.leaves(agent)[0].shape[0]
    first = jax.tree.map(lambda a: a[0], (agent, hazard))
    one = jax.eval_shape(estimator, key, *first, sub)

    def step(i: int, found: Labels) -> Labels:
        start = i * rows
        # The last call repeats rows, so that there is one shape and one compilation.
        index = jnp.minimum(start + jnp.arange(min(rows, count)), count - 1)
        take = lambda tree: jax.tree.map(lambda a: a[index], tree)  # noqa: E731
        chunk = jax.random.fold_in(key, start)
        part = _label(chunk, take(agent), take(hazard), sub, estimator, batch)
        for whole, new in zip(jax.tree.leaves(found), jax.tree.leaves(part), strict=True):
            whole[start : start + rows] = new[: count - start]
        finite("labels", found.threat[start : start + rows])
        if on_progress:
            on_progress(min(start + rows, count), count)
        return found

    blank = jax.tree.map(lambda s: np.zeros((count, *s.shape), s.dtype), one)
    return jax.tree.map(jnp.asarray, checkpoints.loop(blank, step, -(-count // rows)))
