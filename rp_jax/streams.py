"""Every use of random numbers has a stream of its own: no two uses of one key share a draw."""

import enum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array


class Stream(enum.IntEnum):
    """The uses of a key, by what is drawn from it."""

    THREAT = 0  # states and rollouts that threats are learned from
    SUMS = 1  # states and rollouts that sums of threats are judged on
    PLANNING = 2  # learning of the agents
    EVALUATION = 3  # episodes that agents are judged by
    STARTS = 4  # starts of episodes that are drawn
    RECORDING = 5  # the environment in episodes that are drawn
    CERTIFICATE = 6  # episodes of a certificate
    RARE = 7  # estimates of rare crashes
    CRASHES = 8  # crashes that are looked at
    UNTRAINED = 9  # episodes of policies that act at random
    ADAPTERS = 10  # episodes in environments of other libraries
    POLICY_GRADIENT = 11  # learning of the policies of baselines
    SEARCH = 12  # episodes of tree search
    TIMING = 13  # episodes in which decisions are timed
    LOOKAHEAD = 14  # outcomes of actions by which a state's threats are lowered
    LOOKAHEAD_AGAIN = 15  # fresh outcomes of the actions that this alone would admit
    ACCOUNT = 16  # outcomes of a chosen action by which its danger is booked
    CALIBRATION = 18  # states and rollouts that sums of threats are calibrated on
    LOTS = 17  # choices among equally good actions of a search


STATES = 0x100C  # seed of the keys that follow from a state alone


def key_of(key: Array, stream: Stream) -> Array:
    """Returns the key of one use; evaluation never shares one with training.

    Args:
        key: a typed key, the same for all uses.
        stream: the use.
    """
    return jax.random.fold_in(key, int(stream))


def key_of_state(state: Any, stream: Stream) -> Array:
    """Returns a key that follows from a state alone: equal states have one, others do not.

    So a choice may depend on chance and be a function of the state still, with draws that no two
    states, episodes or seeds share.

    Args:
        state: a pytree of arrays, unbatched.
        stream: the use; each has keys of its own.
    """
    words = jnp.concatenate([_words(leaf) for leaf in jax.tree.leaves(state)])
    factors = np.arange(1, words.size + 1, dtype=np.uint32) * np.uint32(0x9E3779B9)
    for shift in (16, 13):  # so that the factors of neighbours have nothing in common
        factors = (factors ^ (factors >> np.uint32(shift))) * np.uint32(0x85EBCA6B)
    mixed = words ^ (words >> 15)
    digest = jnp.sum(mixed * jnp.asarray(factors | np.uint32(1)), dtype=jnp.uint32)
    return jax.random.fold_in(key_of(jax.random.key(STATES), stream), digest)


def _words(leaf: Array) -> Array:
    """Returns the bits of an array as numbers of 32 bits, (n,) uint32."""
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    if leaf.dtype == bool or leaf.dtype.itemsize < 4:
        leaf = leaf.astype(jnp.float32 if jnp.issubdtype(leaf.dtype, jnp.floating) else jnp.int32)
    return jax.lax.bitcast_convert_type(leaf, jnp.uint32).reshape(-1)


def numbered(key: Array, numbers: list[int]) -> Array:
    """Returns one key for each of some numbers, (n,): agent i has the i-th whatever the others.

    Args:
        key: of one use.
        numbers: at least 0.
    """
    return jax.vmap(jax.random.fold_in, (None, 0))(key, jax.numpy.asarray(numbers, "uint32"))
