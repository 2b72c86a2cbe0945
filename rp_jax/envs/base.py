"""What every environment is: pure functions on frozen states, and one automatic reset."""

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax.hazards import SubRMDP


class Outcome(struct.PyTreeNode):
    """What one step earned and how it ended; the carried state is apart."""

    reward: Array  # () without any penalty for danger
    danger: Array  # () d(s, a) of the CMDP, equation 2: 1 on a crash
    terminated: Array  # () bool, the episode has truly ended
    truncated: Array  # () bool, only the time limit has ended it; never both
    goal: Array  # () bool, the task was accomplished

    @property
    def done(self) -> Array:
        """() bool, ended for either reason."""
        return self.terminated | self.truncated


class Hazards(NamedTuple):
    """The hazards of one kind that are present in a state."""

    state: Any  # pytree with a leading axis (n,)
    present: Array  # (n,) bool


class Env(Protocol):
    """An environment is a module (or any object) with these functions; all are unbatched.

    A `State` has the fields `agent` and `time`. `Params` are pytrees: sweep them by `vmap`.
    """

    def reset(self, key: Array, params: Any) -> Any:
        """Draws a start state. Any other state of the same type can be stepped as well."""

    def step(self, key: Array, state: Any, action: Array, params: Any) -> tuple[Any, Outcome]:
        """One transition under `action`, () int."""

    def observe(self, state: Any, params: Any) -> Array:
        """The paper's observation of a state; costs nothing where it is not called."""

    def hazards(self, state: Any, params: Any) -> dict[str, Hazards]:
        """By kind, the hazards that `sub_rmdps` has threats for."""

    def causes(self, state: Any, params: Any) -> dict[str, Array]:
        """By kind, () bool: this hazard is being hit in `state`."""

    def sub_rmdps(self, params: Any) -> dict[str, SubRMDP]:
        """By kind, the sub-R-MDP of one hazard."""

    def num_actions(self, params: Any) -> int:
        """Size of the discrete action set."""


def ended(terminated: Array, time: Array, time_limit: Array) -> tuple[Array, Array]:
    """(terminated, truncated) after step number `time`; the time limit never hides a true end."""
    return terminated, (time >= time_limit) & ~terminated


def select(condition: Array, yes: Any, no: Any) -> Any:
    """`jnp.where` over two pytrees, for a () condition."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def auto_reset_step(
    env: Env, key: Array, state: Any, action: Array, params: Any
) -> tuple[Any, Any, Outcome]:
    """A step that starts a fresh episode wherever one has ended.

    Returns:
        (carried, reached, outcome): `carried` is the state to go on from (a newly drawn start
        after an end); `reached` is the state the step led to, the terminal one included.
    """
    step_key, reset_key = jax.random.split(key)
    reached, outcome = env.step(step_key, state, action, params)
    return select(outcome.done, env.reset(reset_key, params), reached), reached, outcome
