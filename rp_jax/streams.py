"""Every use of random numbers has a stream of its own: no two uses of one key share a draw."""

import enum

import jax
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


def key_of(key: Array, stream: Stream) -> Array:
    """Returns the key of one use; evaluation never shares one with training.

    Args:
        key: a typed key, the same for all uses.
        stream: the use.
    """
    return jax.random.fold_in(key, int(stream))


def numbered(key: Array, numbers: list[int]) -> Array:
    """Returns one key for each of some numbers, (n,): agent i has the i-th whatever the others.

    Args:
        key: of one use.
        numbers: at least 0.
    """
    return jax.vmap(jax.random.fold_in, (None, 0))(key, jax.numpy.asarray(numbers, "uint32"))
