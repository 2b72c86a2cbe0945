"""Baseline policies, functions of the body's own state, under which threats are measured."""

from collections.abc import Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax.dynamics.actions import control_table
from rp_jax.dynamics.vehicle import Control


class BaselinePolicy(Protocol):
    """A baseline policy eta^(o) that sees the body's own state and nothing else (Theorem 3).

    All its randomness comes from `draw`, so that rollouts of several actions can share it.
    """

    def draw(self, key: Array, shape: tuple[int, ...] = ()) -> Any:
        """Returns the random numbers of one step, or of an array of steps.

        Args:
            key: random key.
            shape: shape of the array of steps; () for one step.

        Returns:
            A pytree whose leaves have `shape` as leading axes.
        """

    def act(self, body: Any, noise: Any) -> Any:
        """Returns the control that the policy takes in a state of the body; unbatched.

        Args:
            body: the body's state.
            noise: random numbers of one step, as `draw` returns them.
        """


class ControlDistribution(struct.PyTreeNode):
    """A random policy that draws controls from a table, whatever the state (open-loop)."""

    controls: Any  # (K,) table of a `Control`, or of the controls of another body
    probabilities: Array  # (K,) their probabilities; the sum is 1

    @property
    def rotations(self) -> Array:
        """Every turn that the policy may take, (K, 2) as (cos, sin)."""
        return self.controls.rotation

    @property
    def max_acceleration(self) -> Array:
        """The greatest change of speed in a step, () room units / step^2."""
        return jnp.max(jnp.abs(self.controls.acceleration))

    def act(self, body: Any, noise: Any) -> Any:
        """Returns the control that was drawn, whatever the body's state.

        Args:
            body: the body's state, not used.
            noise: the control, as `draw` returns it.
        """
        return noise

    def draw(self, key: Array, shape: tuple[int, ...] = ()) -> Any:
        """Draws controls of the given shape, by inverting the cumulative distribution.

        Args:
            key: random key.
            shape: leading axes of the result.

        Returns:
            Controls with `shape` as leading axes.
        """
        uniform = jax.random.uniform(key, shape, self.probabilities.dtype)
        edges = jnp.cumsum(self.probabilities)[:-1]
        below = jnp.expand_dims(uniform, -1) >= jnp.broadcast_to(edges, (*shape, len(edges)))
        index = jnp.sum(below, axis=-1)
        return jax.tree.map(lambda table: table[index], self.controls)


def independent_controls(
    accelerations: Sequence[float],
    acceleration_probabilities: Sequence[float],
    turns: Sequence[float],
    turn_probabilities: Sequence[float],
) -> ControlDistribution:
    """Returns a policy that draws acceleration and turn independently of each other.

    Args:
        accelerations: changes of speed, room units / step^2.
        acceleration_probabilities: probability of each of them.
        turns: changes of heading, radians / step; turns to the left are positive.
        turn_probabilities: probability of each of them.
    """
    joint = np.outer(acceleration_probabilities, turn_probabilities).reshape(-1)
    return ControlDistribution(
        controls=control_table(accelerations, turns), probabilities=jnp.asarray(joint, float)
    )


class Plans(struct.PyTreeNode):
    """Several deterministic baseline policies ("plans") that end at rest.

    Each plan turns by the same angle at every step. Its speed goes to a target for some steps, and
    then to 0. Each is a function of the body's own state and of time (Theorem 3).
    """

    rotation: Array  # (K, 2) (cos, sin) of each plan's turn, which some action has as well
    target: Array  # (K,) speed that each plan goes to at first, room units / step
    steps: Array  # (K,) int32, number of steps with that target; afterwards the target is 0
    max_acceleration: Array  # () greatest change of speed in a step, room units / step^2
    horizon: int = struct.field(pytree_node=False)  # steps after which every plan is at rest

    @property
    def rotations(self) -> Array:
        """Every turn that the plans may take, (K, 2) as (cos, sin)."""
        return self.rotation

    @property
    def axes(self) -> "Plans":
        """The `in_axes` of a vmap over the plans."""
        return self.replace(rotation=0, target=0, steps=0, max_acceleration=None)

    def control(self, k: Array | int, speed: Array) -> Control:
        """Returns the command of one plan at its step k; unbatched, `self` holds a single plan.

        Args:
            k: () int, number of steps since the plan began.
            speed: () speed of the vehicle, room units / step.
        """
        wanted = jnp.where(k < self.steps, self.target, 0.0) - speed
        return Control(
            jnp.clip(wanted, -self.max_acceleration, self.max_acceleration), self.rotation
        )


def make_plans(
    turns: Sequence[float],
    targets: Sequence[float],
    steps: int,
    max_acceleration: float,
    max_speed: float,
) -> Plans:
    """Returns plans that brake at once, or after some steps at a target speed, with every turn.

    Args:
        turns: changes of heading, radians / step; turns to the left are positive.
        targets: speeds to keep before braking, room units / step; braking at once is always added.
        steps: number of steps for which a target speed is kept.
        max_acceleration: greatest change of speed in a step, room units / step^2.
        max_speed: greatest speed of the vehicle in either direction, room units / step.

    Returns:
        (1 + len(targets)) * len(turns) plans; the turn varies fastest.
    """
    speeds, waits = (0.0, *targets), (0, *[steps] * len(targets))
    rotation = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    braking = int(np.ceil(max_speed / max_acceleration - 1e-6))
    return Plans(
        rotation=jnp.asarray(np.tile(rotation, (len(speeds), 1)), float),
        target=jnp.asarray(np.repeat(speeds, len(turns)), float),
        steps=jnp.asarray(np.repeat(waits, len(turns)), jnp.int32),
        max_acceleration=jnp.asarray(max_acceleration, float),
        # One step for the first action, one for the last move.
        horizon=1 + max(waits) + braking + 1,
    )
