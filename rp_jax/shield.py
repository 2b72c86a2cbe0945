"""The admissible set of the P-MDP and the choices inside it (Definitions 1 and 3).

Primitives are unbatched: threats and values are (A,), masks (A,) bool.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rp_jax.validate import leading, number, random_key, ranked

WORD = 32  # actions to a word of a stored mask


class Shield(NamedTuple):
    """What a state allows."""

    admissible: Array  # (A,) bool, never empty
    secure: Array  # () bool, s is in S^{eta,x}: some action's threat is at most x


def shield(threat: Array, x: Array | float) -> Shield:
    """A^{eta,x}(s) = {a : T(s, a) <= x}; where that is empty, greedy-eta alone (equation 8).

    A threat that is nan is never admissible; if all are nan, action 0 remains.

    Args:
        threat: (A,) action threats T(s, .).
        x: threshold; infinity switches the shield off.
    """
    ranked(1, threat=threat)
    ranked(0, x=x) if hasattr(x, "shape") else number("x", x, infinite=True)
    allowed = threat <= x
    secure = jnp.any(allowed)
    fallback = jnp.arange(threat.shape[0]) == greedy_eta(threat)
    return Shield(admissible=jnp.where(secure, allowed, fallback), secure=secure)


def rounded_down(x: Any) -> np.ndarray:
    """Thresholds, float64 of any shape, as float32 that are nowhere greater.

    So no action is admissible in float32 that is not in float64: T <= x holds wherever it holds
    for the rounded x and for T, `rounded_up`.
    """
    return -rounded_up(-np.asarray(x, np.float64))


def rounded_up(threat: Any) -> np.ndarray:
    """Threats, float64 of any shape, as float32 that are nowhere less."""
    threat = np.asarray(threat, np.float64)
    with np.errstate(over="ignore"):  # infinity is what is above the largest number
        above = threat.astype(np.float32)
    above = np.where(above < threat, np.nextafter(above, np.float32(np.inf)), above)
    # The smallest numbers are flushed to 0 by compiled code.
    tiny = np.finfo(np.float32).tiny
    return np.where((above > 0) & (above < tiny), tiny, above)


def greedy_eta(threat: Array) -> Array:
    """() int, the least threatening action; nan counts as the worst."""
    return jnp.argmin(jnp.where(jnp.isnan(threat), jnp.inf, threat))


def masked_argmax(values: Array, admissible: Array) -> Array:
    """() int, the admissible action of the greatest value (Algorithm 4, line 6)."""
    ranked(1, values=values, admissible=admissible)
    leading(admissible=admissible, values=values)
    return jnp.argmax(jnp.where(admissible, values, -jnp.inf))


class Correction(NamedTuple):
    """What a shield makes of a policy's wish."""

    action: Array  # () int, an admissible one
    intervened: Array  # () bool, it is not the one wished for
    secure: Array  # () bool, some action's threat is at most x


def correct(
    threat: Array, action: Array, x: Array | float, table: Array | None = None
) -> Correction:
    """The admissible action that comes closest to a policy's wish.

    Args:
        threat: (A,) action threats T(s, .).
        action: the wish. () int: one action; if it is not admissible, the least threatening one is
            taken. (A,) float: scores of all actions; the best admissible one is taken. With a
            table, (D,) float: the nearest admissible row is taken.
        x: threshold; infinity lets every wish pass.
        table: (A, D) the actions that the threats are of.

    Raises:
        ValueError: the wish has a shape or type of none of these.
    """
    mask, secure = shield(threat, x)
    scores = _preference(threat, action, table)
    # Finite, so that masked_argmax tells the worst admissible one from those not admissible.
    scores = jnp.nan_to_num(scores, nan=jnp.finfo(scores.dtype).min)
    taken = masked_argmax(scores, mask)
    return Correction(taken, taken != jnp.argmax(scores), secure)


def _preference(threat: Array, action: Array, table: Array | None) -> Array:
    """(A,) the higher, the more a wish allows for it."""
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
    """() int, uniform over the admissible actions."""
    random_key("key", key)
    ranked(1, admissible=admissible)
    rank = jnp.cumsum(admissible)
    uniform = jax.random.uniform(key)
    chosen = jnp.minimum(jnp.floor(uniform * rank[-1]), rank[-1] - 1)
    return jnp.argmax(rank > chosen)


def to_bits(admissible: Array) -> Array:
    """(W,) uint32, the mask (A,) as words of 32 actions, for storage."""
    ranked(1, admissible=admissible)
    parts = jnp.split(admissible, list(range(WORD, len(admissible), WORD)))
    bits = [part.astype(jnp.uint32) << _places(len(part)) for part in parts]
    return jnp.stack([jnp.sum(word, dtype=jnp.uint32) for word in bits])


def from_bits(bits: Array, num_actions: int) -> Array:
    """(A,) bool, the inverse of `to_bits`."""
    ranked(1, bits=bits)
    number("num_actions", num_actions, least=1, most=WORD * len(bits), integer=True)
    each = (bits[:, None] >> _places(WORD)[None]) & 1
    return each.astype(bool).reshape(-1)[:num_actions]


def _places(count: int) -> Array:
    return jnp.arange(count, dtype=jnp.uint32)
