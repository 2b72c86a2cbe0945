"""Factored CMDPs of Assumption 1, where Theorem 3 can be checked against the joint model.

An agent moves by itself; each of N hazards moves by itself and may react to the agent. Danger 1
is done at a step at which any hazard hits.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax.tabular.cmdp import FiniteCMDP
from rp_jax.tabular.secure import plan, secure
from rp_jax.tabular.threat import Values, threat
from rp_jax.tabular.thresholds import certified


class Hazard(struct.PyTreeNode):
    """One source of danger: p(s_n' | s_n, s_o, a) and d_n(s_o, s_n, a)."""

    transition: Array  # (So, A, Sn, Sn)
    hits: Array  # (So, Sn, A) in [0, 1], an indicator
    start: Array  # (Sn,)


class Factored(struct.PyTreeNode):
    """An agent and its hazards."""

    agent: Array  # (So, A, So) p(s_o' | s_o, a)
    reward: Array  # (So, A)
    start: Array  # (So,)
    hazards: Sequence[Hazard]
    beta: Array  # ()
    horizon: int | None = struct.field(pytree_node=False)


def joint(model: Factored) -> FiniteCMDP:
    """The whole CMDP over (s_o, s_1, ..., s_N), the agent's state counting slowest."""
    agents, actions, _ = model.agent.shape
    kernel = model.agent[:, None, :, :, None]  # (So, rest, A, So', rest')
    free = jnp.ones((agents, 1, actions))  # (So, rest, A) no hazard hits
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
    """The sub-R-MDP of the agent and hazard n alone, over (s_o, s_n)."""
    return joint(model.replace(hazards=[model.hazards[n]]))


def lifted(model: Factored, policy: Array) -> Array:
    """A policy of the agent's state, (So, A) or (H, So, A), on the states of `joint`."""
    rest = 1
    for hazard in model.hazards:
        rest *= len(hazard.start)
    return jnp.repeat(policy, rest, axis=-2)


def sub_threats(model: Factored, policy: Array) -> list[Array]:
    """T^{eta,n} of each hazard, (H, So, Sn, A) (Algorithm 2, line 2).

    Args:
        model: of agent and hazards.
        policy: eta^(o), (So, A) or (H, So, A): it sees the agent's state only (line 1).
    """
    found = []
    for n in range(len(model.hazards)):
        alone = model.replace(hazards=[model.hazards[n]])
        action = threat(sub_rmdp(model, n), lifted(alone, policy)).action
        agents = model.agent.shape[0]
        found.append(action.reshape(len(action), agents, -1, action.shape[-1]))
    return found


def summed(threats: Sequence[Array]) -> Array:
    """(H, S, A) sum of sub-threats at each joint state, the upper bound of Theorem 3."""
    total = threats[0][:, :, :1] * 0
    for one in threats:
        total = total[:, :, :, None] + one[:, :, None]
        total = total.reshape(*total.shape[:2], -1, total.shape[-1])
    return total.reshape(len(total), -1, total.shape[-1])


def approximate(model: Factored, policy: Array, c: Array | float) -> tuple[Array, Values]:
    """Algorithm 2 exactly: the best policy inside the secure sets of the sum of sub-threats.

    Args:
        model: of agent and hazards.
        policy: eta^(o), (So, A) or (H, So, A).
        c: bound on the danger of an episode.

    Returns:
        x, by the certificate (negative: there is none for this c), and the plan.
    """
    cmdp = joint(model)
    total = summed(sub_threats(model, policy))
    x = certified(cmdp, total, c)
    return x, plan(cmdp, secure(total, x).admissible)


def truncation(beta: Array | float, steps: int, worst: Array | float) -> Array:
    """() what a threat from rollouts of `steps` steps may lack: beta^steps times D's maximum.

    Theorem 3 holds for truncated sub-rollouts once this is added to the sum.
    """
    return jnp.asarray(beta, float) ** steps * worst
