"""Secure sets of time-indexed threats, and the worst that policies inside them can do.

Admissible sets are (H, S, A) bool and never empty: where no action is secure, they hold
greedy-eta alone (Definition 3).
"""

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax import shield
from rp_jax.shield import Shield
from rp_jax.tabular.cmdp import FiniteCMDP
from rp_jax.tabular.threat import Values, greedy, solve


def secure(action_threat: Array, x: Array | float) -> Shield:
    """A_t(s) = {a : T_t(s, a) <= x_t} for each step by itself.

    Args:
        action_threat: (H, S, A), or any function above it (`thresholds.certified`).
        x: () or (H,) thresholds.

    Returns:
        The shield's admissible (H, S, A) and secure (H, S).
    """
    x = jnp.broadcast_to(x, action_threat.shape[:1])
    over_states = jax.vmap(shield.shield, in_axes=(0, None))
    return jax.vmap(over_states)(action_threat, x)


def secure_at_all_times(action_threat: Array, x: Array | float) -> Shield:
    """A(s), the intersection of A_t(s) over the steps (equation 5), and so the same at each.

    Where it is empty, greedy-eta of that step, for greedy-eta depends on the step.
    """
    each = secure(action_threat, x)
    always = jnp.all(each.admissible & each.secure[..., None], axis=0)  # (S, A)
    some = jnp.broadcast_to(jnp.any(always, axis=1), each.secure.shape)
    fallback = greedy(action_threat) > 0
    return Shield(jnp.where(some[..., None], always[None], fallback), some)


def secure_by_advantage(threat: Values, y: Array | float) -> Shield:
    """{a : T_t(s, a) - D_t(s) <= y}, not empty for y >= 0 but for rounding (docs/theory.md)."""
    return secure(threat.action - threat.state[..., None], y)


def worst(cmdp: FiniteCMDP, admissible: Array) -> Values:
    """The threat of the most dangerous policy inside the sets, exactly.

    Args:
        cmdp: the CMDP.
        admissible: (H, S, A) bool, not empty.
    """
    return solve(cmdp, cmdp.danger, cmdp.beta, most, admissible)


def plan(cmdp: FiniteCMDP, admissible: Array) -> Values:
    """The P-MDP's best policy inside the sets (equation 10), by value iteration (Algorithm 3).

    Args:
        cmdp: the CMDP.
        admissible: (H, S, A) bool, not empty; greedy-eta alone at insecure states.
    """
    return solve(cmdp, cmdp.reward, cmdp.gamma, most, admissible)


def most(action: Array, admissible: Array) -> Array:
    """(S, A) the policy that takes the admissible action of the greatest value."""
    best = jax.vmap(shield.masked_argmax)(action, admissible)
    return jax.nn.one_hot(best, action.shape[-1], dtype=action.dtype)
