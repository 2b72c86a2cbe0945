"""The contract of an environment: pure functions on immutable states."""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax.hazards import SubRMDP

FUNCTIONS = {  # that each environment must have, with their arguments
    "reset": "(key, params)",
    "step": "(key, state, action, params)",
    "observe": "(state, params)",
    "hazards": "(state, params)",
    "sub_rmdps": "(params)",
}
BASELINES = ("paper", "plans")  # baseline policies that threats may be measured under


FIDELITIES = ("released", "paper")  # as in the code behind the published numbers, or as in the text


class Outcome(struct.PyTreeNode):
    """The result of one step, apart from the state that it led to."""

    reward: Array  # () r(s, a), without any penalty for danger
    danger: Array  # () d(s, a) of the CMDP (equation 2), for example 1 on a crash
    terminated: Array  # () bool, the task has ended: a terminal state
    truncated: Array  # () bool, only the time limit has ended the episode; never with `terminated`
    goal: Array  # () bool, the task was accomplished

    @property
    def done(self) -> Array:
        """Whether the episode has ended for either reason, () bool."""
        return self.terminated | self.truncated


class Hazards(NamedTuple):
    """The hazards of one kind in a state, in arrays of a fixed length."""

    state: Any  # their states, a pytree with leading axis (n,)
    present: Array  # (n,) bool, which rows hold a hazard that exists


class Env(Protocol):
    """An environment: a module, or any object, with these functions, all of them unbatched.

    States have the fields `body` (the state of the body that the agent controls) and `time` (()
    int32, steps since the start). Parameters have the fields `body` (a `rp_jax.dynamics.Body`) and
    `time_limit` (() int32, steps of an episode). Both are pytrees, so that they can be swept by
    `vmap`.

    An environment may have further members, which only some parts of the library need (see
    `rp_jax.envs.optional`):

        num_actions(params)           size of the discrete action set; by default the number of rows
                                      of `params.body.actions`
        collisions(state, params)     by kind, () bool, whether a hazard is being hit; by default
                                      whether one of `hazards` is, as its source says
        clearance(position, params)   () distance left between `position` (2,) and the nearest fixed
                                      hazard, or a lower bound of it. With it `Plans` take all fixed
                                      hazards together, and a world under `Plans` has to have it
        threshold(state, x, least)    () greatest admissible threat in the state, whose least threat
                                      is `least`; by default the
                                      P-MDP's x
        LIDAR_BINS                    how many of an observation's first values are distances of a
                                      LIDAR, a multiple of 8; 0 by default
        SCALE                         factors that bring the other values to the order of 1, for
                                      learners; 1 by default
        make_params(**settings)       parameters from settings, so that saved agents can be
                                      loaded by the environment's name alone
        without_moving_hazards(state) the state without moving hazards, for model predictive
                                      control, which also needs a `behaviour` of the sources of
                                      those that move (`rp_jax.baselines.mpc.Model`)
        mixed_start(key, start, fresh)  a start state with some parts of `start` and the others of
                                      `fresh`, both drawn by `reset`, such that `reset` may draw it
                                      too: the search for starts of rare crashes tries them; by
                                      default one of the two
    """

    def reset(self, key: Array, params: Any) -> Any:
        """Draws a start state; any other state of the same type can be stepped as well.

        No array of it is an array of the parameters too, so that callers may give a state's memory
        away (`donate_argnums` of `jax.jit`).

        Args:
            key: random key.
            params: the environment's parameters.
        """

    def step(self, key: Array, state: Any, action: Array, params: Any) -> tuple[Any, Outcome]:
        """Makes one transition.

        Args:
            key: random key.
            state: the state before.
            action: () int; or floats in [-1, 1] where actions are continuous.
            params: the environment's parameters.

        Returns:
            The state after, and the step's outcome.
        """

    def observe(self, state: Any, params: Any) -> Array:
        """Returns the observation of a state, a flat array of floats.

        Args:
            state: the state.
            params: the environment's parameters.
        """

    def hazards(self, state: Any, params: Any) -> dict[str, Hazards]:
        """Returns, by kind, the hazards that `sub_rmdps` has threats for.

        Args:
            state: the state.
            params: the environment's parameters.
        """

    def sub_rmdps(self, params: Any) -> dict[str, SubRMDP]:
        """Returns, by kind, the sub-R-MDP of the body and one hazard.

        Args:
            params: the environment's parameters.
        """


def hits(
    sub_rmdps: Mapping[str, SubRMDP], body: Any, hazards: Mapping[str, Hazards]
) -> dict[str, Array]:
    """Returns, by kind, whether a hazard is being hit, () bool each.

    Args:
        sub_rmdps: by kind, what `Env.sub_rmdps` returns.
        body: state of the body.
        hazards: by kind, what `Env.hazards` returns.
    """
    return {
        kind: jnp.any(
            jax.vmap(sub_rmdps[kind].source.hits, (None, 0))(body, group.state) & group.present
        )
        for kind, group in hazards.items()
    }


def ended(terminated: Array, time: Array, time_limit: Array) -> tuple[Array, Array]:
    """Returns whether a step ended the task, or only the time limit did; never both.

    Args:
        terminated: () bool, the step led to a terminal state.
        time: () int, number of steps made since the start.
        time_limit: () int, steps of an episode.

    Returns:
        (terminated, truncated).
    """
    return terminated, (time >= time_limit) & ~terminated
