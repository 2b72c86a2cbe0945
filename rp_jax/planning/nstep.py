"""Multi-step returns, from a window over the last steps of each environment."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.planning.dqn import Transition
from rp_jax.planning.percept import Encoded


class WindowStep(NamedTuple):
    """One step of every environment, as the window keeps it."""

    encoded: Encoded  # (B,) observations before the step
    action: Array  # (B,) int32
    reward: Array  # (B,) rewards, penalties included
    terminated: Array  # (B,) bool, a terminal state was reached
    done: Array  # (B,) bool, the episode ended, perhaps by the time limit
    next_encoded: Encoded  # (B,) observations after the step
    next_admissible: Array  # (B, A) bool, the admissible actions after the step


def n_step_transition(window: WindowStep, gamma: float) -> Transition:
    """Returns the transition from a window's first state to its last, or to an episode's end in it.

    Args:
        window: n steps of a single environment, the oldest first; leading axis (n,).
        gamma: discount of reward.
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
