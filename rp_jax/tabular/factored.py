"""Factored CMDPs (Assumption 1), in which Theorem 3 can be checked against the joint model.

A body moves by itself. Each of N hazards moves by itself too, and may react to the body. A step has
danger 1 if any hazard is hit.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax.tabular.cmdp import FiniteCMDP
from rp_jax.tabular.exact import Values, threat
from rp_jax.tabular.secure import plan, secure
from rp_jax.tabular.thresholds import certified


class Hazard(struct.PyTreeNode):
    """A hazard's dynamics p(s_n' | s_n, s_o, a), and its danger d_n(s_o, s_n, a)."""

    transition: Array  # (So, A, Sn, Sn) probabilities of the hazard's next state
    hits: Array  # (So, Sn, A) 1 where the hazard is hit, 0 elsewhere
    start: Array  # (Sn,) distribution of its first state


class Factored(struct.PyTreeNode):
    """A body and its hazards."""

    body: Array  # (So, A, So) probabilities p(s_o' | s_o, a) of the body's next state
    reward: Array  # (So, A) reward
    start: Array  # (So,) distribution of the body's first state
    hazards: Sequence[Hazard]
    beta: Array  # () discount of danger and of reward
    horizon: int | None = struct.field(pytree_node=False)  # number of steps; None: infinite


def joint(model: Factored) -> FiniteCMDP:
    """Returns the whole CMDP over (s_o, s_1, ..., s_N), the last hazard's state varying fastest.

    Args:
        model: the body and its hazards.
    """
    bodies, actions, _ = model.body.shape
    kernel = model.body[:, None, :, :, None]  # (So, rest, A, So', rest')
    free = jnp.ones((bodies, 1, actions))  # (So, rest, A) no hazard hits
    start = model.start
    for hazard in model.hazards:
        moves = jnp.moveaxis(hazard.transition, 1, 2)  # (So, Sn, A, Sn')
        kernel = jnp.einsum("opaqr,oxay->opxaqry", kernel, moves)
        o, p, x, a, q, r, y = kernel.shape
        kernel = kernel.reshape(o, p * x, a, q, r * y)
        free = (free[:, :, None] * (1 - hazard.hits)[:, None]).reshape(o, p * x, a)
        start = jnp.outer(start, hazard.start).ravel()
    o, rest, a, q, _ = kernel.shape
    danger = (1 - free).reshape(o * rest, a)
    return FiniteCMDP(
        transition=kernel.reshape(o * rest, a, q * rest),
        reward=jnp.repeat(model.reward, rest, axis=0),
        danger=danger,
        start=start,
        gamma=model.beta,
        beta=model.beta,
        horizon=model.horizon,
    )


def sub_rmdp(model: Factored, n: int) -> FiniteCMDP:
    """Returns the sub-R-MDP of the body and hazard n alone, over (s_o, s_n).

    Args:
        model: the body and its hazards.
        n: index of the hazard.
    """
    return joint(model.replace(hazards=[model.hazards[n]]))


def lifted(model: Factored, policy: Array) -> Array:
    """Returns a policy over the body's states as one over the states of `joint`.

    Args:
        model: the body and its hazards.
        policy: (So, A) or (H, So, A) probabilities.

    Returns:
        (S, A) or (H, S, A) probabilities.
    """
    rest = 1
    for hazard in model.hazards:
        rest *= len(hazard.start)
    return jnp.repeat(policy, rest, axis=-2)


def sub_threats(model: Factored, policy: Array) -> list[Array]:
    """Returns the threats T^{eta,n} of each hazard (Algorithm 2, line 2).

    Args:
        model: the body and its hazards.
        policy: (So, A) or (H, So, A), the baseline policy eta^(o), which sees only the body's
            state.

    Returns:
        A list with (H, So, Sn, A) threats for each hazard.
    """
    found = []
    for n in range(len(model.hazards)):
        alone = model.replace(hazards=[model.hazards[n]])
        action = threat(sub_rmdp(model, n), lifted(alone, policy)).action
        bodies = model.body.shape[0]
        found.append(action.reshape(len(action), bodies, -1, action.shape[-1]))
    return found


def summed(threats: Sequence[Array]) -> Array:
    """Returns the sum of sub-threats at each joint state, the upper bound of Theorem 3.

    Args:
        threats: (H, So, Sn, A) for each hazard, from `sub_threats`.

    Returns:
        (H, S, A) over the states of `joint`.
    """
    total = threats[0][:, :, :1] * 0
    for one in threats:
        total = total[:, :, :, None] + one[:, :, None]
        total = total.reshape(*total.shape[:2], -1, total.shape[-1])
    return total.reshape(len(total), -1, total.shape[-1])


def approximate(model: Factored, policy: Array, c: Array | float) -> tuple[Array, Values]:
    """Computes Algorithm 2 exactly: the best policy inside the secure sets of the summed threats.

    Args:
        model: the body and its hazards.
        policy: (So, A) or (H, So, A), the baseline policy eta^(o).
        c: bound of the danger of an episode.

    Returns:
        The threshold x that the certificate allows (negative if there is none for this c), and the
        values of the best policy.
    """
    cmdp = joint(model)
    total = summed(sub_threats(model, policy))
    x = certified(cmdp, total, c)
    return x, plan(cmdp, secure(total, x).admissible)


def truncation(beta: Array | float, steps: int, worst: Array | float) -> Array:
    """Returns how much of a threat rollouts of limited length may miss: beta^steps * worst.

    Theorem 3 holds for truncated sub-rollouts once this is added to the sum.

    Args:
        beta: discount of danger.
        steps: number of steps of the rollouts.
        worst: greatest danger that can follow them.

    Returns:
        ().
    """
    return jnp.asarray(beta, float) ** steps * worst
