"""Estimates of the threats of one state in a sub-R-MDP, for all actions at once (equation 3).

The danger is the first occurrence of the hazard's event: T_n(s, a) = E[beta^K 1{K <= horizon}],
where K is the first step at which hazard n is hit (0 if it is hit already) when action a comes
first and the baseline policy eta^(o) follows. All estimators take any start state and return
`Labels`.
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
from rp_jax.dynamics import ControlDistribution, Plans, VehicleModel, delayed, num_threats
from rp_jax.hazards import SubRMDP, is_static
from rp_jax.validate import finite, number, random_key, shared_length


class Labels(struct.PyTreeNode):
    """Estimated threats and their standard errors."""

    threat: Array  # (A,); under K plans (K * A,), the action varying fastest
    stderr: Array  # same shape; 0 where exact, and where all of several sampled paths agree


MOST_LEAVES = 200_000  # greatest number of leaves of a tree that is enumerated

# (key, body, hazard, sub) -> Labels, unbatched.
Estimator = Callable[[Array, Any, Any, SubRMDP], Labels]


def exact_threat(key: Array, body: Any, hazard: Any, sub: SubRMDP) -> Labels:
    """Computes the exact threats of a hazard that does not move, by enumerating baseline controls.

    The tree has `leaves(sub)` leaves.

    Args:
        key: not used; all estimators take one.
        body: the body's state, unbatched.
        hazard: the hazard's state, unbatched.
        sub: the sub-R-MDP; its baseline policy must be a `ControlDistribution`.

    Returns:
        Threats of all actions, with standard errors 0.
    """
    del key
    source, model = sub.source, sub.body
    assert isinstance(model.baseline, ControlDistribution)
    controls, probabilities = model.baseline.controls, model.baseline.probabilities
    any_control = jax.tree.map(lambda table: table[0], controls)
    count, last = len(probabilities), source.horizon - 1 - delayed(model)

    def step(body: Any, control: Any) -> Any:
        return jax.lax.optimization_barrier(model.step(body, control))

    def value(body: Any, k: int) -> Array:
        """Returns E[beta^(K - k) 1{K <= horizon}] from the body's state at step k."""
        hit = source.hits(body, hazard)
        if k == source.horizon:
            later = jnp.zeros_like(sub.beta)
        elif k == source.horizon - 1 and delayed(model):
            later = value(model.step(body, any_control), k + 1)
        elif k >= last:  # one after another: XLA would recompute all levels for each leaf
            rows = [jax.tree.map(lambda table, i=i: table[i], controls) for i in range(count)]
            values = [value(model.step(body, control), k + 1) for control in rows]
            later = sum(p * v for p, v in zip(probabilities, values, strict=True))
        else:
            branch = jax.vmap(lambda control: value(step(body, control), k + 1))
            later = jnp.sum(probabilities * branch(controls))
        return jnp.where(hit, 1.0, sub.beta * later)

    def first(action: Any) -> Array:
        return value(step(body, action), 1)

    threat = jax.vmap(first)(model.actions) * sub.beta
    threat = jnp.where(source.hits(body, hazard), 1.0, threat)
    return Labels(threat=threat, stderr=jnp.zeros_like(threat))


def monte_carlo_threat(
    key: Array, body: Any, hazard: Any, sub: SubRMDP, paths: int = 256
) -> Labels:
    """Estimates the threats of any hazard by averaging rollouts.

    All actions share the same random numbers, and a hazard that does not react to the body is moved
    only once for all of them.

    Args:
        key: random key for the rollouts.
        body: the body's state, unbatched.
        hazard: the hazard's state, unbatched.
        sub: the sub-R-MDP.
        paths: number of rollouts per action.

    Returns:
        Mean threats of all actions, and their standard errors.
    """
    source, model = sub.source, sub.body
    ours, theirs = jax.random.split(key)
    drawn = model.baseline.draw(ours, (source.horizon - 1, paths))
    noise = source.draw(theirs, (source.horizon, paths))
    # Unrolled, a vehicle's steps become a single loop over the paths; those of a simulated body
    # would take minutes to compile.
    unroll = isinstance(model, VehicleModel)

    def rollout(action: Any, drawn: Any, noise: Any) -> Array:
        return _first_hit(body, hazard, sub, action, model.baseline.act, drawn, noise, unroll)

    over_actions = jax.vmap(rollout, (0, None, None))
    values = jax.vmap(over_actions, (None, 1, 1))(model.actions, drawn, noise)  # (paths, A)
    return _average(values)


def plan_threat(key: Array, body: Any, hazard: Any, sub: SubRMDP, paths: int = 256) -> Labels:
    """Estimates the threats T_n^{eta_k}(s, a) of every plan k and action a by averaging rollouts.

    The body's motion is deterministic. The hazard's random numbers are the same for all plans and
    actions.

    Args:
        key: random key for the hazard.
        body: the body's state, unbatched.
        hazard: the hazard's state, unbatched.
        sub: the sub-R-MDP; its baseline policies must be `Plans`.
        paths: number of rollouts per plan and action.

    Returns:
        Mean threats (K * A,), the action varying fastest, and their standard errors.
    """
    source, model = sub.source, sub.body
    assert isinstance(model.baseline, Plans)
    noise = source.draw(key, (source.horizon, paths))

    def rollout(plan: Plans, action: Any, noise: Any) -> Array:
        follow = lambda us, k: plan.control(k, us.speed)  # noqa: E731
        steps = jnp.arange(source.horizon - 1)
        return _first_hit(body, hazard, sub, action, follow, steps, noise)

    plans = model.baseline
    over_actions = jax.vmap(rollout, (None, 0, None))
    over_plans = jax.vmap(over_actions, (plans.axes, None, None))
    values = jax.vmap(over_plans, (None, None, 1))(plans, model.actions, noise)  # (paths, K, A)
    return _average(values.reshape(paths, -1))


def _first_hit(
    body: Any,
    hazard: Any,
    sub: SubRMDP,
    action: Any,
    policy: Callable[[Any, Any], Any],
    inputs: Any,
    noise: Any,
    unroll: bool = False,
) -> Array:
    """Returns beta^K 1{K <= horizon} of one rollout, ().

    Args:
        body: the body's first state.
        hazard: the hazard's first state.
        sub: the sub-R-MDP.
        action: the first control.
        policy: maps the body's state and a row of `inputs` to each later control.
        inputs: (horizon - 1, ...) what the policy gets beside the state, step by step.
        noise: (horizon, ...) the hazard's random numbers.
        unroll: whether to compile the steps one after another instead of as a loop.
    """
    source = sub.source

    def step(carry: Any, control: Any, noise: Any) -> Any:
        us, other, hit, weight, value = carry
        other = source.step(other, us, noise)
        us = sub.body.step(us, control)
        weight = weight * sub.beta
        now = source.hits(us, other) & ~hit
        return us, other, hit | now, weight, jnp.where(now, weight, value)

    def onward(carry: Any, row: Any) -> tuple[Any, None]:
        given, noise = row
        return step(carry, policy(carry[0], given), noise), None

    hit = source.hits(body, hazard)
    value = jnp.where(hit, 1.0, 0.0)
    first, later = jax.tree.map(lambda n: n[0], noise), jax.tree.map(lambda n: n[1:], noise)
    carry = step((body, hazard, hit, jnp.ones_like(value), value), action, first)
    return jax.lax.scan(onward, carry, (inputs, later), unroll=unroll)[0][-1]


def _average(values: Array) -> Labels:
    """Returns the mean over the first axis (paths, ...) and its standard error."""
    paths = values.shape[0]
    values = jax.lax.optimization_barrier(values)  # otherwise each sum would repeat the rollouts
    spread = jnp.std(values, axis=0, ddof=1) if paths > 1 else jnp.ones(values.shape[1])
    return Labels(threat=jnp.mean(values, axis=0), stderr=spread / jnp.sqrt(paths))


def leaves(sub: SubRMDP) -> int:
    """Returns the size of the tree that `exact_threat` enumerates.

    Args:
        sub: the sub-R-MDP; its baseline policy must be a `ControlDistribution`.

    Returns:
        A * K^(horizon - 1) for A actions and K baseline controls; K^(horizon - 2) where controls
        move the body only one step later.
    """
    assert isinstance(sub.body.baseline, ControlDistribution)
    controls = len(sub.body.baseline.probabilities)
    power = max(0, sub.source.horizon - 1 - delayed(sub.body))
    return num_threats(sub.body) * controls**power


def best_estimator(sub: SubRMDP, paths: int, exact: bool = True) -> Estimator:
    """Returns the exact estimator where it is affordable, and a sampling one elsewhere.

    The exact one is affordable where `is_enumerable` says so.

    Args:
        sub: the sub-R-MDP.
        paths: number of rollouts of a sampling estimator.
        exact: False always samples.

    Raises:
        ValueError: `paths` is not a positive integer.
    """
    number("paths", paths, least=1, integer=True)
    if isinstance(sub.body.baseline, Plans):
        return _sampled(plan_threat, paths)
    return exact_threat if exact and is_enumerable(sub) else _sampled(monte_carlo_threat, paths)


def is_enumerable(sub: SubRMDP) -> bool:
    """Returns whether the threats of a sub-R-MDP are found by enumeration, without rollouts.

    They are for hazards that do not move, a baseline policy that draws from a table, and trees of
    at most `MOST_LEAVES` leaves.

    Args:
        sub: the sub-R-MDP.
    """
    listed = isinstance(sub.body.baseline, ControlDistribution)
    return listed and is_static(sub.source) and leaves(sub) <= MOST_LEAVES


@functools.cache
def _sampled(estimator: Callable[..., Labels], paths: int) -> Estimator:
    """Returns an estimator with a fixed number of paths, the same object each time.

    So `label` compiles only once for each number.
    """
    return functools.partial(estimator, paths=paths)


@functools.partial(jax.jit, static_argnames=("estimator", "batch", "mesh"))
def label_rows(
    key: Array,
    body: Any,
    hazard: Any,
    sub: SubRMDP,
    estimator: Estimator,
    batch: int = 16,
    mesh: Mesh | None = None,
) -> Labels:
    """Estimates the threats of many states in one compiled call.

    Args:
        key: random key; each row gets its own key from it.
        body: states of the body, leading axis (n,).
        hazard: states of the hazard, leading axis (n,).
        sub: the sub-R-MDP.
        estimator: estimates the threats of one state.
        batch: number of rows computed side by side; bounds the memory.
        mesh: devices that share the rows; None for one device.

    Returns:
        Labels with leading axis (n,).
    """

    def several(keys: Array, body: Any, hazard: Any, sub: SubRMDP) -> Labels:
        one = lambda row: estimator(row[0], row[1], row[2], sub)  # noqa: E731
        return jax.lax.map(one, (keys, body, hazard), batch_size=batch)

    count = jax.tree.leaves(body)[0].shape[0]
    keys = jax.random.split(key, count)
    if mesh is None:
        return several(keys, body, hazard, sub)
    return devices.shard_rows(several, (0, 0, 0, None), mesh)(keys, body, hazard, sub)


def label(
    key: Array,
    body: Any,
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
    """Estimates the threats of many states, with progress reports and checkpoints.

    Args:
        key: random key; each row gets its own key from it.
        body: states of the body, leading axis (n,).
        hazard: states of the hazard, leading axis (n,).
        sub: the sub-R-MDP.
        estimator: estimates the threats of one state; see `best_estimator`.
        batch: number of rows computed side by side; bounds the memory.
        rows: number of rows between two reports of progress.
        on_progress: called with (rows done, n).
        mesh: devices that share the rows; None for one device.
        checkpoints: where to save the labels that are done.

    Returns:
        Labels with leading axis (n,).

    Raises:
        ValueError: a number is not positive, or the bodies and hazards differ in number.
        FloatingPointError: a label is not a finite number.
    """
    random_key("key", key)
    count = shared_length(body=body, hazard=hazard)
    number("batch", batch, least=1, integer=True)
    rows = min(int(number("rows", rows, least=1, integer=True)), count)
    rows += 0 if mesh is None else -rows % mesh.size
    first = jax.tree.map(lambda a: a[0], (body, hazard))
    one = jax.eval_shape(estimator, key, *first, sub)

    def step(i: int, found: Labels) -> Labels:
        start = i * rows
        # The last call repeats rows, so that all calls have one shape and share a compilation.
        index = jnp.minimum(start + jnp.arange(rows), count - 1)
        take = lambda tree: jax.tree.map(lambda a: a[index], tree)  # noqa: E731
        chunk = jax.random.fold_in(key, start)
        part = label_rows(chunk, take(body), take(hazard), sub, estimator, batch, mesh)
        part = devices.gather(part, mesh)
        for whole, new in zip(jax.tree.leaves(found), jax.tree.leaves(part), strict=True):
            whole[start : start + rows] = new[: count - start]
        finite("labels", found.threat[start : start + rows])
        if on_progress:
            on_progress(min(start + rows, count), count)
        return found

    blank = jax.tree.map(lambda s: np.zeros((count, *s.shape), s.dtype), one)
    return jax.tree.map(jnp.asarray, checkpoints.loop(blank, step, -(-count // rows)))
