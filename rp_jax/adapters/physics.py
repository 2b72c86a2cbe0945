"""Bodies simulated by brax: sub-R-MDPs can begin in any state of its pipeline."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax.adapters.quiet import quietly
from rp_jax.dynamics import ControlDistribution, mirror_images

with quietly():
    from brax import kinematics
    from brax.base import System
    from brax.generalized import pipeline
    from brax.io import mjcf


class JointState(struct.PyTreeNode):
    """The state that a simulation continues from, unbatched or along leading axes."""

    q: Array  # (..., Q) positions of the joints
    qd: Array  # (..., V) velocities of the joints


class BraxBody(struct.PyTreeNode):
    """A body with actuators: a `rp_jax.dynamics.Body` whose states are `JointState`.

    Each step is one of brax's generalized pipeline, the fastest of its three on a CPU.
    """

    actions: Array  # (A, U) table of actuator inputs
    baseline: ControlDistribution  # eta^(o), over actuator inputs (K, U)
    model: str = struct.field(pytree_node=False)  # the body as MJCF text
    mirror: tuple[int, ...] | None = struct.field(pytree_node=False, default=None)  # factor, 1 or
    # -1, of each actuator's input in the left-right mirrored situation; None: no symmetry

    @property
    def num_threats(self) -> int:
        """The number of threats of a state, one per action."""
        return self.actions.shape[0]

    @property
    def delayed(self) -> bool:
        """Whether a control moves the body only one step later: False, it acts at once."""
        return False

    def control(self, action: Array) -> Array:
        """Returns the actuator inputs of an action, (U,).

        Args:
            action: () int, a row of the table; or (U,) float, the inputs themselves.
        """
        action = jnp.asarray(action)
        discrete = jnp.issubdtype(action.dtype, jnp.integer)
        return self.actions[action] if discrete else action

    def step(self, body: JointState, control: Array) -> JointState:
        """Returns the body's next state after one step of the pipeline; unbatched.

        Args:
            body: the state before.
            control: (U,) actuator inputs.
        """
        system = load(self.model)
        with quietly(), jax.numpy_dtype_promotion("standard"):  # brax relies on it
            state = pipeline.step(system, pipeline.init(system, body.q, body.qd), control)
        return JointState(q=state.q, qd=state.qd)

    def places(self, body: JointState) -> Array:
        """Returns the positions of the origins of the body's links, (L, 3); unbatched.

        Args:
            body: the body's state.
        """
        with jax.numpy_dtype_promotion("standard"):
            return kinematics.forward(load(self.model), body.q, body.qd)[0].pos

    def mirrored_threats(self) -> np.ndarray:
        """Returns the index of each action's left-right mirror image, (A,) int.

        Raises:
            ValueError: there is no `mirror`, or the table does not hold the mirror image of every
                action.
        """
        table = np.asarray(self.actions)
        if self.mirror is None:
            raise ValueError(
                "mirror is None; it must be given where a hazard source has `mirrored`"
            )
        missing = "actions: the table holds no mirror image of some of its actions"
        return mirror_images(table, self.mirror, missing)


def load(model: str) -> System:
    """Returns the system that an MJCF text describes, in the current floating-point precision.

    Args:
        model: MJCF text.

    Raises:
        ValueError: the text is not a model.
    """
    return _load(model, jax.dtypes.canonicalize_dtype(float))


@functools.cache
def _load(model: str, _: Any) -> System:
    # Constants, even if the first call happens inside a trace.
    """Returns the system, loaded once for each text and precision."""
    with quietly(), jax.ensure_compile_time_eval():
        return mjcf.loads(model)
