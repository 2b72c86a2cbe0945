"""Returns over several steps, from a window over the last ones of each environment."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.planning.dqn import Transition
from rp_jax.planning.pmdp import Encoded


class Taken(NamedTuple):
    """One step of every environment, as the n-step window keeps it."""

    encoded: Encoded
    action: Array  # (B,)
    reward: Array  # (B,) penalty and toll included
    terminated: Array  # (B,)
    done: Array  # (B,)
    next_encoded: Encoded
    next_admissible: Array  # (B, W) bits


def n_step_transition(window: Taken, gamma: float) -> Transition:
    """The transition from the window's first step to its last, or to the first end in it.

    `window` is of a single environment: leading axis (n,).
    """
    n = window.reward.shape[0]
    before = jnp.cumsum(window.done) - window.done == 0  # no end before this step
    last = jnp.sum(before) - 1
    powers = gamma ** jnp.arange(n)
    at = lambda tree, i: jax.tree.map(lambda a: a[i], tree)  # noqa: E731
    return Transition(
        encoded=at(window.encoded, 0),
        action=window.action[0],
        reward=jnp.sum(jnp.where(before, powers * window.reward, 0.0)),
        discount=jnp.where(window.terminated[last], 0.0, gamma * powers[last]),
        next_encoded=at(window.next_encoded, last),
        next_admissible=window.next_admissible[last],
    )
