"""Threats of policies (equations 3, 4 and 9), by backward induction or by linear equations.

A policy is an array of probabilities, (S, A), or (H, S, A) if it depends on time. All results are
time-indexed, because threats are: T_0 with a stationary greedy policy is not safe.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax import shield
from rp_jax.tabular.cmdp import FiniteCMDP, array_of, distribution

ROUNDS = 1_000  # greatest number of rounds of policy iteration; it converges after a few


class Values(NamedTuple):
    """A policy with its values, or its threats."""

    action: Array  # (H, S, A) values of actions, such as T_t(s, a) or Q_t(s, a)
    state: Array  # (H, S) values of states, such as D_t(s) or V_t(s)
    policy: Array  # (H, S, A) probabilities


def solve(
    cmdp: FiniteCMDP,
    signal: Array,
    discount: Array,
    choose: Callable[[Array, Any], Array],
    data: Any = None,
) -> Values:
    """Computes values of a policy that is chosen from these values, step by step.

    Q_t = signal_t + discount P V_{t+1}, pi_t = choose(Q_t, data_t), V_t = pi_t Q_t, V_T = 0. A
    finite horizon is solved by backward induction; for the infinite one the fixed point is found by
    policy iteration with exact evaluation.

    Args:
        cmdp: the CMDP, of which only the transitions are used.
        signal: (S, A) or (H, S, A), reward or danger of a step.
        discount: () discount of the signal.
        choose: maps values (S, A) and this step's data to a policy (S, A).
        data: pytree of (H, ...) arrays.
    """
    signal = jnp.broadcast_to(signal, cmdp.shape)

    def values_before(signal_t: Array, after: Array) -> Array:
        return signal_t + discount * (cmdp.transition @ after)

    def back(after: Array, now: tuple[Array, Any]) -> tuple[Array, Values]:
        signal_t, data_t = now
        action = values_before(signal_t, after)
        policy = choose(action, data_t)
        state = jnp.sum(policy * action, axis=1)
        return state, Values(action, state, policy)

    if cmdp.horizon is not None:
        last = jnp.zeros(cmdp.shape[1], signal.dtype)
        return jax.lax.scan(back, last, (signal, data), reverse=True)[1]

    signal_0, data_0 = jax.tree.map(lambda leaf: leaf[0], (signal, data))

    def improve(carry: tuple[Values, Array, Array]) -> tuple[Values, Array, Array]:
        """Evaluates the chosen policy, and continues while its values lead to a better choice."""
        values, _, rounds = carry
        kernel = jnp.einsum("sa,saz->sz", values.policy, cmdp.transition)
        gain = jnp.sum(values.policy * signal_0, axis=1)
        state = jnp.linalg.solve(jnp.eye(len(kernel)) - discount * kernel, gain)
        action = values_before(signal_0, state)
        policy = choose(action, data_0)
        # Among ties the choice may alternate without end, so rounding errors end it as well.
        better = jnp.abs(jnp.sum(policy * action, axis=1) - state)
        rounding = 32 * jnp.finfo(signal.dtype).eps * jnp.max(jnp.abs(state))
        going = jnp.any(policy != values.policy) & (jnp.max(better) > rounding)
        return Values(action, state, policy), going, rounds + 1

    first = Values(signal_0, signal_0[:, 0], choose(signal_0, data_0))
    found, _, _ = jax.lax.while_loop(
        lambda carry: carry[1] & (carry[2] < ROUNDS),
        improve,
        (first, jnp.asarray(True), jnp.asarray(0)),
    )
    return jax.tree.map(lambda leaf: leaf[None], found)


def check_policy(cmdp: FiniteCMDP, policy: Any) -> Array:
    """Returns a policy as a time-indexed array, checked.

    Args:
        cmdp: the CMDP.
        policy: (S, A) or (H, S, A) probabilities.

    Returns:
        (H, S, A) probabilities.

    Raises:
        ValueError: the policy has another shape, or a row is not a distribution.
    """
    rows = array_of("policy", policy)
    if rows.shape not in (cmdp.shape, cmdp.shape[1:]):
        raise ValueError(
            f"policy has shape {rows.shape}; it must be {cmdp.shape[1:]} or {cmdp.shape}"
        )
    return jnp.broadcast_to(jnp.asarray(distribution("policy", rows)), cmdp.shape)


def evaluate(cmdp: FiniteCMDP, signal: Array, discount: Array, policy: Array) -> Values:
    """Returns the values of a given policy.

    Args:
        cmdp: the CMDP, of which only the transitions are used.
        signal: (S, A) or (H, S, A), reward or danger of a step.
        discount: () discount of the signal.
        policy: (S, A) or (H, S, A) probabilities.
    """
    policy = jnp.broadcast_to(policy, cmdp.shape)
    return solve(cmdp, signal, discount, lambda _, given: given, policy)


def threat(cmdp: FiniteCMDP, policy: Array) -> Values:
    """Returns action threats T_t^pi (equation 3) and state threats D_t^pi (equation 4) of a policy.

    Args:
        cmdp: the CMDP.
        policy: (S, A) or (H, S, A) probabilities.
    """
    return evaluate(cmdp, cmdp.danger, cmdp.beta, policy)


def returns(cmdp: FiniteCMDP, policy: Array) -> Values:
    """Returns the values Q_t^pi and V_t^pi of a policy's reward.

    Args:
        cmdp: the CMDP.
        policy: (S, A) or (H, S, A) probabilities.
    """
    return evaluate(cmdp, cmdp.reward, cmdp.gamma, policy)


def expected(cmdp: FiniteCMDP, values: Values) -> Array:
    """Returns the expected value of the first state, E[V_0(s_0)], ().

    Args:
        cmdp: the CMDP.
        values: from `threat` for the danger of an episode, from `returns` for its return.
    """
    return cmdp.start @ values.state[0]


def uniform(cmdp: FiniteCMDP) -> Array:
    """Returns the uniformly random policy, eta_0 of section 5.2, (S, A).

    Args:
        cmdp: the CMDP.
    """
    return jnp.full(cmdp.danger.shape, 1 / cmdp.danger.shape[1])


def greedy(action_threat: Array) -> Array:
    """Returns greedy-eta, which takes the least threatening action of each step (Definition 3).

    Args:
        action_threat: (..., A) threats.

    Returns:
        (..., A) probabilities, 0 or 1.
    """
    best = jnp.vectorize(shield.greedy_eta, signature="(a)->()")(action_threat)
    return jax.nn.one_hot(best, action_threat.shape[-1], dtype=action_threat.dtype)


def policy_iteration(cmdp: FiniteCMDP, policy: Array, rounds: int) -> list[Array]:
    """Returns policies eta_0, eta_1, ..., each greedy for the threats of the one before it.

    Args:
        cmdp: the CMDP.
        policy: (S, A) or (H, S, A), eta_0.
        rounds: number of policies after eta_0.
    """
    found = [jnp.broadcast_to(policy, cmdp.shape)]
    for _ in range(rounds):
        found.append(greedy(threat(cmdp, found[-1]).action))
    return found


def least_threat(cmdp: FiniteCMDP) -> Values:
    """Returns the policy eta* with its threats, the least at every state and step (equation 9).

    Args:
        cmdp: the CMDP.
    """
    return solve(cmdp, cmdp.danger, cmdp.beta, lambda action, _: greedy(action))
