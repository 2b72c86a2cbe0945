"""Threats of one state in a sub-R-MDP: T_n(s, a) of equation 3, for all actions at once.

All estimators take any start state and return the same thing. The danger is the event's first
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
from jax.sharding import Mesh

from rp_jax import devices
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.hazards import SubRMDP
from rp_jax.kinematics import AgentModel, ControlDistribution, Plans
from rp_jax.validate import finite, leading, number, random_key


class Labels(struct.PyTreeNode):
    """Threats and their standard errors."""

    threat: Array  # (A,); (K * A,) where the baseline is K plans, plans counting slower
    stderr: Array  # alike, 0 where exact, and where all of several sampled paths agree


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
    count, last = len(probabilities), source.horizon - 1 - model.delayed

    def step(agent: Any, control: Any) -> Any:
        return jax.lax.optimization_barrier(model.step(agent, control))

    def value(agent: Any, k: int) -> Array:
        """E[beta^(K - k)] from the agent's state at step k, for all steps up to the horizon."""
        hit = source.hits(agent, hazard)
        if k == source.horizon:
            later = jnp.zeros_like(sub.beta)
        elif k == source.horizon - 1 and model.delayed:
            later = value(model.step(agent, any_control), k + 1)
        elif k >= last:  # added up one after another: XLA would do all levels anew for each leaf
            rows = [jax.tree.map(lambda table, i=i: table[i], controls) for i in range(count)]
            values = [value(model.step(agent, control), k + 1) for control in rows]
            later = sum(p * v for p, v in zip(probabilities, values, strict=True))
        else:
            branch = jax.vmap(lambda control: value(step(agent, control), k + 1))
            later = jnp.sum(probabilities * branch(controls))
        return jnp.where(hit, 1.0, sub.beta * later)

    def first(action: Any) -> Array:
        return value(step(agent, action), 1)

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
    # Unrolled, a vehicle's steps become one loop over the paths; a simulated body's would take
    # minutes to compile.
    unroll = isinstance(model, AgentModel)

    def rollout(action: Any, controls: Any, noise: Any) -> Array:
        given = lambda _, control: control  # noqa: E731
        return _first_hit(agent, hazard, sub, action, given, controls, noise, unroll)

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
        follow = lambda us, k: plan.control(k, us.speed)  # noqa: E731
        steps = jnp.arange(source.horizon - 1)
        return _first_hit(agent, hazard, sub, action, follow, steps, noise)

    plans = model.baseline
    over_actions = jax.vmap(rollout, (None, 0, None))
    over_plans = jax.vmap(over_actions, (plans.axes, None, None))
    values = jax.vmap(over_plans, (None, None, 1))(plans, model.actions, noise)  # (paths, K, A)
    return _average(values.reshape(paths, -1))


def _first_hit(
    agent: Any,
    hazard: Any,
    sub: SubRMDP,
    action: Any,
    policy: Callable[[Any, Any], Any],
    inputs: Any,
    noise: Any,
    unroll: bool = False,
) -> Array:
    """() beta^K 1{K <= horizon} of one path.

    Args:
        agent: its first state.
        hazard: its first state.
        sub: the sub-R-MDP.
        action: the first control.
        policy: every later one, from the agent's state and a row of `inputs`.
        inputs: (horizon - 1, ...).
        noise: (horizon, ...) the hazard's random numbers.
        unroll: compile the steps one after another, not as a loop.
    """
    source = sub.source

    def step(carry: Any, control: Any, noise: Any) -> Any:
        us, other, hit, weight, value = carry
        other = source.step(other, us, noise)
        us = sub.agent.step(us, control)
        weight = weight * sub.beta
        now = source.hits(us, other) & ~hit
        return us, other, hit | now, weight, jnp.where(now, weight, value)

    def onward(carry: Any, row: Any) -> tuple[Any, None]:
        given, noise = row
        return step(carry, policy(carry[0], given), noise), None

    hit = source.hits(agent, hazard)
    value = jnp.where(hit, 1.0, 0.0)
    first, later = jax.tree.map(lambda n: n[0], noise), jax.tree.map(lambda n: n[1:], noise)
    carry = step((agent, hazard, hit, jnp.ones_like(value), value), action, first)
    return jax.lax.scan(onward, carry, (inputs, later), unroll=unroll)[0][-1]


def _average(values: Array) -> Labels:
    """Mean over paths (paths, ...) and its standard error."""
    paths = values.shape[0]
    values = jax.lax.optimization_barrier(values)  # or each sum would roll out anew
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
    return sub.agent.num_threats * controls**power


def best_estimator(sub: SubRMDP, paths: int, exact: bool = True) -> Estimator:
    """Exact enumeration where the hazard stays put and the tree is small enough.

    Elsewhere, or if not `exact`, Monte Carlo with `paths` rollouts, at least 1.

    Raises:
        ValueError: paths is not a number of paths.
    """
    number("paths", paths, least=1, integer=True)
    if isinstance(sub.agent.baseline, Plans):
        return _sampled(plan_threat, paths)
    if exact and sub.source.static and leaves(sub) <= MOST_LEAVES:
        return exact_threat
    return _sampled(monte_carlo_threat, paths)


@functools.cache
def _sampled(estimator: Callable[..., Labels], paths: int) -> Estimator:
    """One object per number of paths, so that `label` compiles once for it."""
    return functools.partial(estimator, paths=paths)


@functools.partial(jax.jit, static_argnames=("estimator", "batch", "mesh"))
def label_rows(
    key: Array,
    agent: Any,
    hazard: Any,
    sub: SubRMDP,
    estimator: Estimator,
    batch: int = 16,
    mesh: Mesh | None = None,
) -> Labels:
    """One compiled call of `label`: all rows (n, ...), `batch` of them side by side."""

    def several(keys: Array, agent: Any, hazard: Any, sub: SubRMDP) -> Labels:
        one = lambda row: estimator(row[0], row[1], row[2], sub)  # noqa: E731
        return jax.lax.map(one, (keys, agent, hazard), batch_size=batch)

    count = jax.tree.leaves(agent)[0].shape[0]
    keys = jax.random.split(key, count)
    if mesh is None:
        return several(keys, agent, hazard, sub)
    return devices.share_out(several, (0, 0, 0, None), mesh)(keys, agent, hazard, sub)


def label(
    key: Array,
    agent: Any,
    hazard: Any,
    sub: SubRMDP,
    estimator: Estimator,
    *,
    batch: int = 16,
    rows: int = 8192,
    on_progress: Callable[[int, int], None] | None = None,
    mesh: Mesh | None = None,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> Labels:
    """Labels many states, leading axis (n,), `rows` to a call and `batch` side by side.

    Args:
        key: each row gets its own from it.
        agent: (n, ...) agent states.
        hazard: (n, ...) hazard states.
        sub: the sub-R-MDP.
        estimator: `exact_threat`, `plan_threat` or a `monte_carlo_threat`; see `best_estimator`.
        batch: rows simulated at once; bounds the memory.
        rows: rows between two reports of progress.
        on_progress: called with (rows done, n).
        mesh: of devices that share the rows; None for one device.
        checkpoints: of these labels.

    Raises:
        ValueError: a count is not above 0, or there are not as many agents as hazards.
        FloatingPointError: a label is not a finite number.
    """
    random_key("key", key)
    count = leading(agent=agent, hazard=hazard)
    number("batch", batch, least=1, integer=True)
    rows = min(int(number("rows", rows, least=1, integer=True)), count)
    rows += 0 if mesh is None else -rows % mesh.size
    first = jax.tree.map(lambda a: a[0], (agent, hazard))
    one = jax.eval_shape(estimator, key, *first, sub)

    def step(i: int, found: Labels) -> Labels:
        start = i * rows
        # The last call repeats rows, so that there is one shape and one compilation.
        index = jnp.minimum(start + jnp.arange(rows), count - 1)
        take = lambda tree: jax.tree.map(lambda a: a[index], tree)  # noqa: E731
        chunk = jax.random.fold_in(key, start)
        part = label_rows(chunk, take(agent), take(hazard), sub, estimator, batch, mesh)
        part = devices.gather(part, mesh)
        for whole, new in zip(jax.tree.leaves(found), jax.tree.leaves(part), strict=True):
            whole[start : start + rows] = new[: count - start]
        finite("labels", found.threat[start : start + rows])
        if on_progress:
            on_progress(min(start + rows, count), count)
        return found

    blank = jax.tree.map(lambda s: np.zeros((count, *s.shape), s.dtype), one)
    return jax.tree.map(jnp.asarray, checkpoints.loop(blank, step, -(-count // rows)))
