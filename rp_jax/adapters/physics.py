"""A body simulated by brax as the one who acts: sub-R-MDPs begin at any state of its pipeline."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax.adapters.quiet import quietly
from rp_jax.kinematics import ControlDistribution, mirror_images

with quietly():
    from brax import kinematics
    from brax.base import System
    from brax.generalized import pipeline
    from brax.io import mjcf


class Body(struct.PyTreeNode):
    """All that a pipeline starts from, unbatched or along leading axes."""

    q: Array  # (..., Q) positions of the joints
    qd: Array  # (..., V) their velocities


class PipelineAgent(struct.PyTreeNode):
    """A body with actuators; a `rp_jax.hazards.Agent` whose states are `Body`.

    Each step is one of brax's generalized pipeline, the lightest of its three on a CPU.
    """

    actions: Array  # (A, U) table of actuator inputs
    baseline: ControlDistribution  # over such inputs (K, U)
    model: str = struct.field(pytree_node=False)  # the body, as MJCF text
    mirror: tuple[int, ...] | None = struct.field(pytree_node=False, default=None)  # the factor,
    # 1 or -1, of each actuator's input in the left-right mirrored situation; None: no symmetry

    @property
    def num_threats(self) -> int:
        """One per action."""
        return self.actions.shape[0]

    @property
    def delayed(self) -> bool:
        """False: an input changes velocities, and with them positions, in the same step."""
        return False

    def control(self, action: Array) -> Array:
        """(U,) actuator inputs of an action: () int, a row of the table; or (U,) float, as is."""
        action = jnp.asarray(action)
        discrete = jnp.issubdtype(action.dtype, jnp.integer)
        return self.actions[action] if discrete else action

    def step(self, body: Body, control: Array) -> Body:
        """One step of the pipeline, begun at this very state; unbatched."""
        system = load(self.model)
        with quietly():
            state = pipeline.step(system, pipeline.init(system, body.q, body.qd), control)
        return Body(q=state.q, qd=state.qd)

    def places(self, body: Body) -> Array:
        """(L, 3) where the origins of the body's links are; unbatched."""
        return kinematics.forward(load(self.model), body.q, body.qd)[0].pos

    def mirrored_threats(self) -> np.ndarray:
        """(A,) index of each action's mirror image.

        Raises:
            ValueError: the table holds no mirror image of some of its actions.
        """
        table = np.asarray(self.actions)
        if self.mirror is None:
            return np.arange(len(table))
        missing = "actions: the table holds no mirror image of some of its actions"
        return mirror_images(table, self.mirror, missing)


def load(model: str) -> System:
    """The system that an MJCF text describes, in the precision that is on.

    Raises:
        ValueError: the text is no model.
    """
    return _load(model, jax.dtypes.canonicalize_dtype(float))


@functools.cache
def _load(model: str, _: Any) -> System:
    # Constants, even where the first one to ask is being traced.
    with quietly(), jax.ensure_compile_time_eval():
        return mjcf.loads(model)
