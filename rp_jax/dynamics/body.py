"""Models of moving bodies: their contract, and vehicles that fulfil it."""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax.dynamics.actions import mirror_images, mirrored_actions
from rp_jax.dynamics.baseline import ControlDistribution, Plans
from rp_jax.dynamics.geometry import angle_of
from rp_jax.dynamics.vehicle import Control, Vehicle, advance


class Body(Protocol):
    """The model of a body that moves: a `VehicleModel`, or a body of any simulator.

    States and controls are pytrees of the model's own; the methods are unbatched. Two more members
    are optional. `delayed` (bool, False by default) says that a control moves the body only one
    step later, so that enumeration may skip the last control. `mirrored_threats()` returns the
    index (num_threats,) of the left-right mirror image of each plan and action, the action varying
    fastest; without it the body has no such symmetry.
    """

    actions: Any  # table of controls, leading axis (A,)
    baseline: Any  # eta^(o), a `BaselinePolicy` over such controls, or `Plans`

    def control(self, action: Array) -> Any:
        """Returns the control of an action.

        Args:
            action: () int, index into the table.
        """

    def step(self, body: Any, control: Any) -> Any:
        """Returns the body's next state, distributed as p(s_o' | s_o, a).

        Args:
            body: the body's state.
            control: one control.
        """


def num_threats(model: Body) -> int:
    """Returns the number of threats of a state: one per action, or one per plan and action.

    Args:
        model: the body's model.
    """
    plans = len(model.baseline.target) if isinstance(model.baseline, Plans) else 1
    return plans * jax.tree.leaves(model.actions)[0].shape[0]


def delayed(model: Body) -> bool:
    """Returns whether a control moves the body only one step later; False by default.

    Args:
        model: the body's model.
    """
    return getattr(model, "delayed", False)


class VehicleModel(struct.PyTreeNode):
    """A vehicle's actions, limits and dynamics, and the baseline policy eta^(o) of its threats."""

    actions: Control  # (A,) table of discrete actions
    baseline: ControlDistribution | Plans  # eta^(o), functions of the body alone (Theorem 3)
    speeds: Array  # (S,) the speeds reachable from rest, ascending, room units / step
    room: Array | None = None  # () half the side of the square around the origin that it stays in
    delayed: bool = struct.field(pytree_node=False, default=True)  # a control moves the vehicle
    # only one step later (see `advance`), so that exact enumeration may skip the last control

    @property
    def normalized_actions(self) -> Array:
        """The table's rows as continuous actions, (A, 2) in [-1, 1], as `control` takes them."""
        both = self.actions.acceleration, angle_of(self.actions.rotation)
        return jnp.stack([part / jnp.max(jnp.abs(part)) for part in both], axis=-1)

    def control(self, action: Array) -> Control:
        """Returns the command of a discrete or a continuous action.

        Threats are given for the rows of the table only.

        Args:
            action: () int, a row of the table; or (2,) float, acceleration and turn as fractions in
                [-1, 1] of the greatest ones in the table. Numbers outside that range are clipped.
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
        """Returns the vehicle's next state; unbatched.

        Args:
            vehicle: the state before.
            control: the command.
        """
        moved = advance(vehicle, control, self.speeds, self.delayed)
        if self.room is None:
            return moved
        return moved.replace(position=jnp.clip(moved.position, -self.room, self.room))

    def mirrored_threats(self) -> np.ndarray:
        """Returns the index of the left-right mirror image of each plan and action.

        Returns:
            (num_threats,) int; the action varies fastest.

        Raises:
            ValueError: the actions or the plans have no such symmetry.
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
