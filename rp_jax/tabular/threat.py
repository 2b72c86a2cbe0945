"""Threats of policies (equations 3, 4 and 9), by backward induction or by linear equations.

A policy is (S, A), or time-indexed (H, S, A), of probabilities. Everything returned is
time-indexed, because threats are: T_0 with a stationary greedy policy is not safe.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax import shield
from rp_jax.tabular.cmdp import FiniteCMDP, array_of, distribution

ROUNDS = 1_000  # of policy iteration at most; it ends by itself after few


class Values(NamedTuple):
    """Of the policy that was chosen."""

    action: Array  # (H, S, A) as T_t(s, a) or Q_t(s, a)
    state: Array  # (H, S) as D_t(s) or V_t(s)
    policy: Array  # (H, S, A)


def solve(
    cmdp: FiniteCMDP,
    signal: Array,
    discount: Array,
    choose: Callable[[Array, Any], Array],
    data: Any = None,
) -> Values:
    """Q_t = signal_t + discount P V_{t+1}, V_t = pi_t Q_t, pi_t = choose(Q_t, data_t), V_T = 0.

    Backward induction for a finite horizon; for the infinite one its fixed point, by policy
    iteration with exact evaluation.

    Args:
        cmdp: whose transitions are used.
        signal: (S, A) or (H, S, A), reward or danger of a step.
        discount: () of the signal.
        choose: from (S, A) values and this step's data to a policy (S, A).
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
        """Values of the chosen policy, and what it would choose; not done while that differs."""
        values, _, rounds = carry
        kernel = jnp.einsum("sa,saz->sz", values.policy, cmdp.transition)
        gain = jnp.sum(values.policy * signal_0, axis=1)
        state = jnp.linalg.solve(jnp.eye(len(kernel)) - discount * kernel, gain)
        action = values_before(signal_0, state)
        policy = choose(action, data_0)
        # Ties may change hands for ever: no difference beyond rounding ends it too.
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
    """(H, S, A) a policy, given as that or stationary (S, A).

    Raises:
        ValueError: its shape is another, or a row is no distribution.
    """
    rows = array_of("policy", policy)
    if rows.shape not in (cmdp.shape, cmdp.shape[1:]):
        raise ValueError(
            f"policy has shape {rows.shape}; it must be {cmdp.shape[1:]} or {cmdp.shape}"
        )
    return jnp.broadcast_to(jnp.asarray(distribution("policy", rows)), cmdp.shape)


def evaluate(cmdp: FiniteCMDP, signal: Array, discount: Array, policy: Array) -> Values:
    """Values of one policy, as `check_policy` would pass it: `solve` without a choice."""
    policy = jnp.broadcast_to(policy, cmdp.shape)
    return solve(cmdp, signal, discount, lambda _, given: given, policy)


def threat(cmdp: FiniteCMDP, policy: Array) -> Values:
    """Action threat T_t^pi (equation 3) and state threat D_t^pi (equation 4)."""
    return evaluate(cmdp, cmdp.danger, cmdp.beta, policy)


def returns(cmdp: FiniteCMDP, policy: Array) -> Values:
    """Q_t^pi and V_t^pi of the reward."""
    return evaluate(cmdp, cmdp.reward, cmdp.gamma, policy)


def expected(cmdp: FiniteCMDP, values: Values) -> Array:
    """() E[V_0(s_0)]: of `threat` the danger of an episode, of `returns` its return."""
    return cmdp.start @ values.state[0]


def uniform(cmdp: FiniteCMDP) -> Array:
    """(S, A) the uniformly random policy, eta_0 of section 5.2."""
    return jnp.full(cmdp.danger.shape, 1 / cmdp.danger.shape[1])


def greedy(action_threat: Array) -> Array:
    """(..., A) greedy-eta as probabilities, for each step by itself (Definition 3)."""
    best = jnp.vectorize(shield.greedy_eta, signature="(a)->()")(action_threat)
    return jax.nn.one_hot(best, action_threat.shape[-1], dtype=action_threat.dtype)


def policy_iteration(cmdp: FiniteCMDP, policy: Array, rounds: int) -> list[Array]:
    """eta_0, eta_1, ..., each greedy with respect to the threat of the one before it."""
    found = [jnp.broadcast_to(policy, cmdp.shape)]
    for _ in range(rounds):
        found.append(greedy(threat(cmdp, found[-1]).action))
    return found


def least_threat(cmdp: FiniteCMDP) -> Values:
    """The threat of eta* (equation 9), the least at every state and step at once."""
    return solve(cmdp, cmdp.danger, cmdp.beta, lambda action, _: greedy(action))
