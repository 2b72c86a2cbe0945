"""Secure sets of time-indexed threats, and the worst that policies inside them can do.

Admissible sets are (H, S, A) bool and never empty: in an insecure state, where no action's threat
is at most x, they hold the action of greedy-eta alone, the least threatening one (Definition 3).
"""

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax import shield
from rp_jax.shield import Shield
from rp_jax.tabular.cmdp import FiniteCMDP
from rp_jax.tabular.exact import Values, greedy, solve


def secure(action_threat: Array, x: Array | float) -> Shield:
    """Returns the sets A_t(s) = {a : T_t(s, a) <= x_t} of each step.

    Args:
        action_threat: (H, S, A) threats, or any upper bound of them (`thresholds.certified`).
        x: () or (H,) thresholds.

    Returns:
        The shield, with admissible (H, S, A) and secure (H, S).
    """
    x = jnp.broadcast_to(shield.narrowed(x, action_threat.dtype), action_threat.shape[:1])
    over_states = jax.vmap(shield.shield, in_axes=(0, None))
    return jax.vmap(over_states)(action_threat, x)


def secure_at_all_times(action_threat: Array, x: Array | float) -> Shield:
    """Returns the sets A(s), the intersection of A_t(s) over all steps (equation 5).

    Where A(s) is empty, it holds the least threatening action of each step, which may differ.

    Args:
        action_threat: (H, S, A) threats.
        x: () or (H,) thresholds.

    Returns:
        The shield, with admissible (H, S, A) and secure (H, S).
    """
    each = secure(action_threat, x)
    always = jnp.all(each.admissible & each.secure[..., None], axis=0)  # (S, A)
    some = jnp.broadcast_to(jnp.any(always, axis=1), each.secure.shape)
    fallback = greedy(action_threat) > 0
    return Shield(jnp.where(some[..., None], always[None], fallback), some)


def secure_by_advantage(threat: Values, y: Array | float) -> Shield:
    """Returns the sets {a : T_t(s, a) - D_t(s) <= y}, never empty for y >= 0 (docs/theory.md).

    Rounding can make one empty; it then holds the least threatening action.

    Args:
        threat: action threats T and state threats D of the baseline policy.
        y: () or (H,) thresholds of the difference.

    Returns:
        The shield, with admissible (H, S, A) and secure (H, S).
    """
    return secure(threat.action - threat.state[..., None], y)


def worst(cmdp: FiniteCMDP, admissible: Array) -> Values:
    """Returns the threats of the most dangerous policy inside the sets, exactly.

    Args:
        cmdp: the CMDP.
        admissible: (H, S, A) bool, nowhere empty.
    """
    return solve(cmdp, cmdp.danger, cmdp.beta, most, admissible)


def plan(cmdp: FiniteCMDP, admissible: Array) -> Values:
    """Returns the best policy inside the sets (equation 10), by value iteration (Algorithm 3).

    Args:
        cmdp: the CMDP.
        admissible: (H, S, A) bool, nowhere empty; in insecure states only the least threatening
            action.

    Returns:
        The policy with its values.
    """
    return solve(cmdp, cmdp.reward, cmdp.gamma, most, admissible)


def most(action: Array, admissible: Array) -> Array:
    """Returns the policy that takes the admissible action of the greatest value.

    Args:
        action: (S, A) values.
        admissible: (S, A) bool.

    Returns:
        (S, A) probabilities, 0 or 1.
    """
    best = jax.vmap(shield.masked_argmax)(action, admissible)
    return jax.nn.one_hot(best, action.shape[-1], dtype=action.dtype)
