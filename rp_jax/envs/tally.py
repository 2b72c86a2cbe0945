"""Sums of reward and danger over the episodes of a batch while they are under way."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.envs.contract import Outcome


class Running(NamedTuple):
    """Sums over the steps of the episodes under way, (B,) each."""

    score: Array  # (B,) reward so far, without any penalty for danger
    danger: Array  # (B,) danger so far


class Ended(NamedTuple):
    """Sums over the episodes that ended in a step, () each; counts are int32."""

    episodes: Array  # number of episodes
    score: Array  # their reward, without any penalty for danger
    danger: Array  # their danger
    crashes: Array  # number of episodes with any danger
    goals: Array  # number of episodes that reached the goal


def count(flags: Array) -> Array:
    """Returns how many flags are set, () int32: a float32 counts to 16.8 million only.

    Args:
        flags: bool, of any shape.
    """
    return jnp.sum(flags, dtype=jnp.int32)


def tally(running: Running, outcome: Outcome) -> tuple[Running, Ended]:
    """Adds a step to the sums of a batch of episodes; those of ended episodes start again at 0.

    Args:
        running: sums so far, (B,).
        outcome: outcome of the step, (B,).

    Returns:
        The sums to continue with, and the sums over the episodes that ended in this step.
    """
    total = Running(running.score + outcome.reward, running.danger + outcome.danger)
    ended = Ended(
        episodes=count(outcome.done),
        score=jnp.sum(jnp.where(outcome.done, total.score, 0.0)),
        danger=jnp.sum(jnp.where(outcome.done, total.danger, 0.0)),
        crashes=count(outcome.done & (total.danger > 0)),
        goals=count(outcome.goal),
    )
    return jax.tree.map(lambda a: jnp.where(outcome.done, 0.0, a), total), ended
