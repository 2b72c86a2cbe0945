"""Vehicle dynamics: the only copy, shared by agents, moving obstacles, rollouts and adapters."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array


class Control(struct.PyTreeNode):
    """One command, or a table of commands along leading axes."""

    acceleration: Array  # (...) room units / step^2; of a point, its step forward
    rotation: Array  # (..., 2) (cos, sin) of the turn; turns to the left are positive


class Vehicle(struct.PyTreeNode):
    """Pose and speed of a vehicle, unbatched or along leading axes."""

    position: Array  # (..., 2) room units
    heading: Array  # (..., 2) unit vector (cos, sin)
    speed: Array  # (...) room units / step, negative when reversing


class ControlDistribution(struct.PyTreeNode):
    """A state-independent random policy over a table of controls (an open-loop eta^(o))."""

    controls: Any  # (K,) table, of a `Control` or of what else an agent takes
    probabilities: Array  # (K,) sums to one

    @property
    def rotations(self) -> Array:
        """(K, 2) every turn it may take."""
        return self.controls.rotation

    @property
    def strongest(self) -> Array:
        """() greatest change of speed in a step."""
        return jnp.max(jnp.abs(self.controls.acceleration))

    def sample(self, key: Array, shape: tuple[int, ...] = ()) -> Any:
        """Draws controls of the given shape, by inverting the cumulative distribution."""
        uniform = jax.random.uniform(key, shape, self.probabilities.dtype)
        edges = jnp.cumsum(self.probabilities)[:-1]
        below = jnp.expand_dims(uniform, -1) >= jnp.broadcast_to(edges, (*shape, len(edges)))
        index = jnp.sum(below, axis=-1)
        return jax.tree.map(lambda table: table[index], self.controls)


class Plans(struct.PyTreeNode):
    """Several deterministic baseline policies, each a function of the agent alone.

    A plan turns by the same angle at every step; its speed goes to a target for some steps, and
    then to a halt.
    """

    rotation: Array  # (K, 2) (cos, sin) of the turn, one that the actions offer
    target: Array  # (K,) speed to go to at first, room units / step
    steps: Array  # (K,) int32, how long; from then on the target is 0
    strongest: Array  # () greatest change of speed in a step
    horizon: int = struct.field(pytree_node=False)  # steps after which every plan stands still

    @property
    def rotations(self) -> Array:
        """(K, 2) every turn it may take."""
        return self.rotation

    @property
    def axes(self) -> "Plans":
        """`in_axes` of a vmap over the plans."""
        return self.replace(rotation=0, target=0, steps=0, strongest=None)

    def control(self, k: Array | int, speed: Array) -> Control:
        """The command of one plan at its step k, (); a row of the table, unbatched."""
        wanted = jnp.where(k < self.steps, self.target, 0.0) - speed
        return Control(jnp.clip(wanted, -self.strongest, self.strongest), self.rotation)


def make_plans(
    turns: Sequence[float], targets: Sequence[float], steps: int, strongest: float, fastest: float
) -> Plans:
    """Braking at once, or after `steps` steps at each target speed, with each of the turns.

    Args:
        turns: radians a step.
        targets: speeds, room units a step, beside braking at once.
        steps: for which a target is kept.
        strongest: change of speed in a step.
        fastest: greatest speed, either way.
    """
    speeds, waits = (0.0, *targets), (0, *[steps] * len(targets))
    rotation = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    braking = int(np.ceil(fastest / strongest - 1e-6))
    return Plans(
        rotation=jnp.asarray(np.tile(rotation, (len(speeds), 1)), float),
        target=jnp.asarray(np.repeat(speeds, len(turns)), float),
        steps=jnp.asarray(np.repeat(waits, len(turns)), jnp.int32),
        strongest=jnp.asarray(strongest, float),
        # One step for the first action, one for the last move.
        horizon=1 + max(waits) + braking + 1,
    )


class AgentModel(struct.PyTreeNode):
    """What the agent can do, and the baseline policy eta^(o) its threat is measured under."""

    actions: Control  # (A,) table of discrete actions
    baseline: ControlDistribution | Plans  # eta^(o), functions of the agent alone (Theorem 3)
    speeds: Array  # (S,) the speeds reachable from rest, ascending; the ends are the limits
    room: Array | None = None  # () half the side of the square about the origin it cannot leave
    delayed: bool = struct.field(pytree_node=False, default=True)  # see `advance`: where a control
    # moves the agent only one step later, exact enumeration may skip the last one

    @property
    def num_threats(self) -> int:
        """Threats of a state: one per action, or one per plan and action (plans count slower)."""
        plans = len(self.baseline.target) if isinstance(self.baseline, Plans) else 1
        return plans * len(self.actions.acceleration)

    @property
    def shares(self) -> Array:
        """(A, 2) the table's rows as the continuous actions that `control` takes for them."""
        both = self.actions.acceleration, angle_of(self.actions.rotation)
        return jnp.stack([part / jnp.max(jnp.abs(part)) for part in both], axis=-1)

    def control(self, action: Array) -> Control:
        """The command of an action: () int, a row of the table; or (2,) float, any in between.

        A continuous action is acceleration and turn, each as a share in [-1, 1] of the table's
        strongest; greater ones are cut. The threat function speaks of the table's rows alone.
        """
        action = jnp.asarray(action)
        if jnp.issubdtype(action.dtype, jnp.integer):
            return jax.tree.map(lambda table: table[action], self.actions)
        share = jnp.clip(action, -1.0, 1.0)
        turn = share[1] * jnp.max(jnp.abs(angle_of(self.actions.rotation)))
        return Control(
            acceleration=share[0] * jnp.max(jnp.abs(self.actions.acceleration)),
            rotation=jnp.stack([jnp.cos(turn), jnp.sin(turn)]),
        )

    def step(self, vehicle: Vehicle, control: Control) -> Vehicle:
        """The next state of the agent; unbatched in `vehicle` and `control`."""
        moved = advance(vehicle, control, self.speeds, self.delayed)
        if self.room is None:
            return moved
        return moved.replace(position=jnp.clip(moved.position, -self.room, self.room))

    def mirrored_threats(self) -> np.ndarray:
        """(num_threats,) index of the mirror image of each plan and action.

        Raises:
            ValueError: the actions, or the plans, have no such symmetry.
        """
        actions = mirrored_actions(self.actions)
        if not isinstance(self.baseline, Plans):
            return actions
        plans, count = self.baseline, len(actions)
        columns = [plans.rotation, plans.target[:, None], plans.steps[:, None]]
        table = np.concatenate([np.asarray(c) for c in columns], axis=-1)
        missing = "baseline: there is no mirror image of some of the plans"
        images = mirror_images(table, [1, -1, 1, 1], missing)
        return (images[:, None] * count + actions[None]).ravel()


def make_vehicle(position, heading, speed) -> Vehicle:
    """Builds a `Vehicle` from a position (..., 2), a heading angle (...) in radians and a speed."""
    angle = jnp.asarray(heading, float)
    return Vehicle(
        position=jnp.asarray(position, float),
        heading=jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1),
        speed=jnp.asarray(speed, float),
    )


def control_table(accelerations: Sequence[float], turns: Sequence[float]) -> Control:
    """All pairs of an acceleration and a turn (radians); index = i_acc * len(turns) + i_turn."""
    acceleration = np.repeat(np.asarray(accelerations, float), len(turns))
    turn = np.tile(np.asarray(turns, float), len(accelerations))
    return Control(
        acceleration=jnp.asarray(acceleration, float),
        rotation=jnp.asarray(np.stack([np.cos(turn), np.sin(turn)], axis=-1), float),
    )


def independent_controls(
    accelerations: Sequence[float],
    acceleration_probabilities: Sequence[float],
    turns: Sequence[float],
    turn_probabilities: Sequence[float],
) -> ControlDistribution:
    """Acceleration and turn drawn independently of one another."""
    joint = np.outer(acceleration_probabilities, turn_probabilities).reshape(-1)
    return ControlDistribution(
        controls=control_table(accelerations, turns), probabilities=jnp.asarray(joint, float)
    )


def mirrored_actions(actions: Control) -> np.ndarray:
    """(A,) index of each action's left-right mirror image.

    Raises:
        ValueError: the table of actions has no such symmetry.
    """
    acceleration, rotation = np.asarray(actions.acceleration), np.asarray(actions.rotation)
    table = np.concatenate([acceleration[:, None], rotation], axis=-1)
    return mirror_images(
        table, [1, 1, -1], "actions: the table holds no mirror image of some of its actions"
    )


def mirror_images(table: np.ndarray, signs: Sequence[int], missing: str) -> np.ndarray:
    """(n,) index of the row that each row (n, F) becomes under the signs of its columns.

    Raises:
        ValueError: one becomes none of them; the message is `missing`.
    """
    gap = np.abs(table[:, None] - table[None] * np.asarray(signs)).max(axis=-1)
    if (gap.min(axis=-1) > 1e-6).any():
        raise ValueError(missing)
    return gap.argmin(axis=-1)


def rotate(vector: Array, rotation: Array) -> Array:
    """Turns `vector` (..., 2) by the angle whose (cos, sin) is `rotation` (..., 2)."""
    x, y = vector[..., 0], vector[..., 1]
    c, s = rotation[..., 0], rotation[..., 1]
    return jnp.stack([x * c - y * s, x * s + y * c], axis=-1)


def to_ego(vector: Array, heading: Array) -> Array:
    """Expresses a world vector (..., 2) in the frame whose x axis is `heading` (..., 2)."""
    x, y = vector[..., 0], vector[..., 1]
    c, s = heading[..., 0], heading[..., 1]
    return jnp.stack([x * c + y * s, y * c - x * s], axis=-1)


def squared_distance(a: Array, b: Array) -> Array:
    """Squared distance (...) of two positions (..., 2)."""
    x, y = a[..., 0] - b[..., 0], a[..., 1] - b[..., 1]
    return x * x + y * y


def angle_of(vector: Array) -> Array:
    """The angle of `vector` (..., 2) in radians, in (-pi, pi]."""
    return jnp.arctan2(vector[..., 1], vector[..., 0])


def advance(vehicle: Vehicle, control: Control, speeds: Array, delayed: bool = True) -> Vehicle:
    """One step: move along the old heading at the old speed, then change speed and heading.

    Args:
        vehicle: the state before; unbatched or with leading axes that broadcast.
        control: the command.
        speeds: (S,) ascending; the new speed is clipped to its ends.
        delayed: false for a point without inertia, which changes first, then moves at the new
            speed along the new heading, and stands still again.
    """
    changed = Vehicle(
        position=vehicle.position,
        heading=rotate(vehicle.heading, control.rotation),
        speed=jnp.clip(vehicle.speed + control.acceleration, speeds[0], speeds[-1]),
    )
    moving = vehicle if delayed else changed
    return Vehicle(
        position=vehicle.position + moving.heading * moving.speed[..., None],
        heading=changed.heading,
        speed=changed.speed if delayed else jnp.zeros_like(changed.speed),
    )
