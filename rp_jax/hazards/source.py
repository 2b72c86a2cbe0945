"""The contract of a kind of hazard, and the sub-R-MDP of one body and one hazard (Assumption 1).

An R-MDP (reconnaissance MDP) is a CMDP without its reward: a body that follows a baseline policy,
and the danger that it meets. A sub-R-MDP holds the body and a single hazard. The threats estimated
in it are summed over all hazards of a state (Theorem 3).
"""

from typing import Any, Protocol

from flax import struct
from jax import Array


class HazardSource(Protocol):
    """One kind of hazard: how it moves, when it strikes, and how a threat model sees it.

    All methods are unbatched. A hazard never depends on other hazards (Assumption 1); its event,
    such as a collision, is E_n. Three more members are optional. `static` (bool, False by default)
    says that hazards of this kind do not move, so that their threats can be enumerated.
    `mirrored(features)` returns the features (..., F) of the left-right mirrored situation; without
    it the kind has no such symmetry. `grid(model, nodes)` returns (low (F,), step (F,), shape): the
    first node, the steps and the numbers of nodes of a grid of about so many features, on which
    threats are tabled; without it they are fitted by a network.
    """

    @property
    def horizon(self) -> int:
        """The number of steps after which a rollout of the sub-R-MDP is cut."""

    def draw(self, key: Array, shape: tuple[int, ...] = ()) -> Any:
        """Returns the random numbers of one step, or of an array of steps.

        Args:
            key: random key.
            shape: shape of the array of steps; () for one step.

        Returns:
            A pytree whose leaves have `shape` as leading axes.
        """

    def step(self, hazard: Any, body: Any, noise: Any) -> Any:
        """Returns the hazard's next state, distributed as p(s_n' | s_n, s_o, a).

        Args:
            hazard: the hazard's state.
            body: the body's state before the step.
            noise: random numbers of one step, as `draw` returns them.
        """

    def hits(self, body: Any, hazard: Any) -> Array:
        """Returns whether the hazard is being hit, () bool: the indicator d_n of its event.

        Args:
            body: the body's state.
            hazard: the hazard's state.
        """

    def in_reach(self, body: Any, hazard: Any) -> Array:
        """Returns whether the hazard may be hit within `horizon` steps under any actions, () bool.

        Where it is False, the threat is taken to be 0.

        Args:
            body: the body's state.
            hazard: the hazard's state.
        """

    def features(self, body: Any, hazard: Any) -> Array:
        """Returns what a threat model sees of a body and a hazard, (F,) floats.

        Positions are in the body's frame, or along the world's axes where a body has no heading;
        the hazard's relative position comes first.

        Args:
            body: the body's state.
            hazard: the hazard's state.
        """

    def sample(self, key: Array, model: Any) -> tuple[Any, Any]:
        """Draws a body and a hazard from all pairs that are `in_reach`, every speed included.

        Args:
            key: random key.
            model: the body's model.

        Returns:
            The body's state and the hazard's state.
        """

    def state_of(self, features: Array) -> tuple[Any, Any]:
        """Returns a body and a hazard that have given features, the inverse of `features`.

        Args:
            features: (F,).

        Returns:
            The body's state and the hazard's state.
        """


def is_static(source: HazardSource) -> bool:
    """Returns whether hazards of a kind do not move; False by default.

    Args:
        source: the kind of hazard.
    """
    return getattr(source, "static", False)


class SubRMDP(struct.PyTreeNode):
    """A body with its baseline policy, and a single hazard (Algorithm 2, line 2)."""

    body: Any  # the body's model, a `rp_jax.dynamics.Body`
    source: Any  # the kind of hazard, a `HazardSource`
    beta: Array | float = 0.999  # () discount of danger per step
