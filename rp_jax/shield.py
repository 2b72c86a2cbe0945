"""The admissible set of the P-MDP and the choices inside it (Definitions 1 and 3).

The threat T(s, a) is the expected danger of taking action a in state s and following the baseline
policy eta afterwards. An action is admissible if its threat is at most the threshold x. A state
with such an action is called secure; in an insecure one only the least threatening action, that of
the policy "greedy-eta", is admissible.

All functions are unbatched: threats and values are (A,), masks (A,) bool, for A actions.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rp_jax.validate import number, random_key, ranked, shared_length


class Shield(NamedTuple):
    """The actions that a state allows."""

    admissible: Array  # (A,) bool, never empty
    secure: Array  # () bool, some action's threat is at most x: the state is in S^{eta,x}


def shield(threat: Array, x: Array | float) -> Shield:
    """Returns the admissible set A^{eta,x}(s) = {a : T(s, a) <= x} of a state.

    Where that set is empty, the least threatening action alone is admissible (equation 8). A threat
    that is nan is never admissible; if all are nan, action 0 is.

    Args:
        threat: (A,) threats T(s, .) of the actions.
        x: () threshold; infinity switches the shield off. A plain number is rounded down to the
            precision of the threats; `jax.jit` rounds an argument to the nearest number instead, so
            give it as a constant there, or round it before (`rounded_down`).

    Returns:
        The set as a mask (A,), and whether the state is secure, ().

    Raises:
        ValueError: an argument is not a number, or has another number of axes.
    """
    ranked(1, threat=threat)
    ranked(0, x=x) if hasattr(x, "shape") else number("x", x, infinite=True)
    if isinstance(x, Array):
        threat = threat_array(threat)
    allowed = threat <= narrowed(x, threat.dtype)
    secure = jnp.any(allowed)
    fallback = jnp.arange(threat.shape[0]) == greedy_eta(threat)
    return Shield(admissible=jnp.where(secure, allowed, fallback), secure=secure)


def narrowed(x: Any, dtype: Any) -> Any:
    """Returns thresholds in a precision, nowhere greater than they were given.

    Rounded to the nearest number, a threshold could admit a threat that is above it.

    Args:
        x: thresholds, of any shape; arrays of JAX are returned as they are.
        dtype: type of the threats that they are compared with.
    """
    if isinstance(x, Array):
        return x
    return rounded_down(x) if jnp.dtype(dtype).itemsize <= 4 else np.asarray(x, np.float64)


def threshold_array(x: Any) -> Array:
    """Returns thresholds as an array in JAX's precision, nowhere greater than they were given.

    Args:
        x: numbers, of any shape.
    """
    return jnp.asarray(narrowed(x, jax.dtypes.canonicalize_dtype(float)))


def threat_array(threat: Any) -> Array:
    """Returns threats as an array in JAX's precision, nowhere less than they were given.

    Args:
        threat: threats, of any shape; arrays of JAX are returned as they are.
    """
    if isinstance(threat, Array):
        return threat
    double = jax.dtypes.canonicalize_dtype(float) == np.float64
    return jnp.asarray(threat, float) if double else jnp.asarray(rounded_up(threat))


def rounded_down(x: Any) -> np.ndarray:
    """Returns thresholds as float32 numbers that are nowhere greater.

    With threats passed through `rounded_up`, an action that is admissible in float32 is admissible
    in float64 as well.

    Args:
        x: thresholds in float64, of any shape.
    """
    return -rounded_up(-np.asarray(x, np.float64))


def rounded_up(threat: Any) -> np.ndarray:
    """Returns threats as float32 numbers that are nowhere less.

    Args:
        threat: threats in float64, of any shape; those beyond the largest float32 become infinity.
    """
    threat = np.asarray(threat, np.float64)
    with np.errstate(over="ignore"):  # beyond the largest float32 comes infinity
        above = threat.astype(np.float32)
    above = np.where(above < threat, np.nextafter(above, np.float32(np.inf)), above)
    # Compiled code would flush subnormal numbers to 0.
    tiny = np.finfo(np.float32).tiny
    return np.where((above > 0) & (above < tiny), tiny, above)


def greedy_eta(threat: Array) -> Array:
    """Returns the least threatening action.

    Args:
        threat: (A,) threats of the actions; nan counts as the worst.

    Returns:
        () int, the action's index.
    """
    return jnp.argmin(jnp.where(jnp.isnan(threat), jnp.inf, threat))


def masked_argmax(values: Array, admissible: Array) -> Array:
    """Returns the admissible action of the greatest value (Algorithm 4, line 6).

    Args:
        values: (A,) values of the actions.
        admissible: (A,) bool.

    Returns:
        () int, the action's index.

    Raises:
        ValueError: the arguments are not two arrays of one length.
    """
    ranked(1, values=values, admissible=admissible)
    shared_length(admissible=admissible, values=values)
    return jnp.argmax(jnp.where(admissible, values, -jnp.inf))


class Correction(NamedTuple):
    """A policy's proposal after the shield has looked at it."""

    action: Array  # () int, the admissible action to take
    intervened: Array  # () bool, it is not the proposed one
    secure: Array  # () bool, some action's threat is at most x


def correct(
    threat: Array, action: Array, x: Array | float, table: Array | None = None
) -> Correction:
    """Returns the admissible action that comes closest to a policy's proposal.

    Args:
        threat: (A,) threats T(s, .) of the actions.
        action: the proposal. () int: one action; if it is not admissible, the least threatening one
            is taken. (A,) float: scores of all actions; the best admissible one is taken. With a
            table, (D,) float: a continuous action; the nearest admissible row is taken.
        x: () threshold; infinity lets every proposal pass.
        table: (A, D) the continuous actions that the threats belong to.

    Raises:
        ValueError: the proposal has none of these shapes and types.
    """
    mask, secure = shield(threat, x)
    scores = _preference(threat, action, table)
    # Finite scores, so that masked_argmax ranks every admissible action above the inadmissible.
    scores = jnp.nan_to_num(scores, nan=jnp.finfo(scores.dtype).min)
    taken = masked_argmax(scores, mask)
    return Correction(taken, taken != jnp.argmax(scores), secure)


def _preference(threat: Array, action: Array, table: Array | None) -> Array:
    """Returns scores (A,), the higher, the closer an action comes to the proposal."""
    ranked(np.ndim(action), action=action)
    real = jnp.issubdtype(action.dtype, jnp.floating)
    if table is not None:
        ranked(2, table=table)
        shape: tuple[int, ...] = (table.shape[1],)
        if real and action.shape == shape:
            return -jnp.sum(jnp.square(action[None] - table), axis=-1)
    else:
        shape = threat.shape
        if real and action.shape == shape:
            return action
        if jnp.issubdtype(action.dtype, jnp.integer) and action.shape == ():
            return jnp.where(jnp.arange(len(threat)) == action, jnp.inf, -threat)
    raise ValueError(
        f"action is {action.dtype} of shape {action.shape}; it must be "
        f"{'' if table is not None else 'an integer, or '}floats of shape {shape}"
    )


def masked_sample(key: Array, admissible: Array) -> Array:
    """Draws one of the admissible actions, all equally likely.

    Args:
        key: random key.
        admissible: (A,) bool.

    Returns:
        () int, the action's index.

    Raises:
        ValueError: the key is not a single typed key, or the mask has another number of axes.
    """
    random_key("key", key)
    ranked(1, admissible=admissible)
    return masked_choice(jax.random.uniform(key), admissible)


def masked_choice(uniform: Array, admissible: Array) -> Array:
    """Returns the admissible action that a random number falls on, all equally likely.

    Args:
        uniform: () random number, uniform on [0, 1).
        admissible: (A,) bool.

    Returns:
        () int, the action's index.
    """
    rank = jnp.cumsum(admissible)
    chosen = jnp.minimum(jnp.floor(uniform * rank[-1]), rank[-1] - 1)
    return jnp.argmax(rank > chosen)
