"""What every environment is: pure functions on frozen states, and one automatic reset."""

import math
from collections.abc import Callable
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


class Running(NamedTuple):
    """What the episodes that are going on have come to, (B,) each."""

    score: Array  # reward
    danger: Array


class Ended(NamedTuple):
    """Sums over the episodes that ended in a step."""

    episodes: Array
    score: Array  # reward, without any penalty for danger
    danger: Array
    crashes: Array  # episodes with any danger
    goals: Array


def tally(running: Running, outcome: Outcome) -> tuple[Running, Ended]:
    """Counts a step (B,); what ended begins at 0 again."""
    total = Running(running.score + outcome.reward, running.danger + outcome.danger)
    dtype = total.score.dtype
    ended = Ended(
        episodes=jnp.sum(outcome.done, dtype=dtype),
        score=jnp.sum(jnp.where(outcome.done, total.score, 0.0)),
        danger=jnp.sum(jnp.where(outcome.done, total.danger, 0.0)),
        crashes=jnp.sum(outcome.done & (total.danger > 0), dtype=dtype),
        goals=jnp.sum(outcome.goal, dtype=dtype),
    )
    return jax.tree.map(lambda a: jnp.where(outcome.done, 0.0, a), total), ended


BASELINES = ("paper", "plans")  # policies that threats are measured under
FIDELITIES = ("released", "paper")  # as the published numbers were made, or as the text says
FARTHEST = 30  # steps within which wall points are hit, at most: the look-up tables grow with it


def least_radius(gap: float, fastest: float) -> float:
    """What a vehicle's radius must exceed for walls, points at most `gap` apart, to hold it.

    Hits are looked for where steps end. A step of length `fastest` through the middle of a gap
    begins and ends half of it from the wall; the vehicle has to touch the wall from there.
    """
    return math.hypot(gap, fastest) / 2


class Hazards(NamedTuple):
    """The hazards of one kind that are present in a state."""

    state: Any  # pytree with a leading axis (n,)
    present: Array  # (n,) bool


class Env(Protocol):
    """An environment is a module (or any object) with these functions; all are unbatched.

    A `State` has the fields `agent` and `time` (steps since the start), `Params` have `agent` (of
    rp_jax.hazards.Agent) and `time_limit`. `Params` are pytrees: sweep them by `vmap`.
    """

    @property
    def LIDAR_BINS(self) -> int:  # noqa: N802
        """How many of an observation's first values are a LIDAR's distances: a multiple of 8."""

    @property
    def SCALE(self) -> tuple[float, ...]:  # noqa: N802
        """Brings the others to the order of 1, for learners."""

    def reset(self, key: Array, params: Any) -> Any:
        """Draws a start state. Any other state of the same type can be stepped as well."""

    def step(self, key: Array, state: Any, action: Array, params: Any) -> tuple[Any, Outcome]:
        """One transition under `action`: () int, or floats in [-1, 1] for a continuous one."""

    def observe(self, state: Any, params: Any) -> Array:
        """The paper's observation of a state; costs nothing where it is not called."""

    def hazards(self, state: Any, params: Any) -> dict[str, Hazards]:
        """By kind, the hazards that `sub_rmdps` has threats for."""

    def causes(self, state: Any, params: Any) -> dict[str, Array]:
        """By kind, () bool: this hazard is being hit in `state`."""

    def clearance(self, position: Array, params: Any) -> Array:
        """() how far `position` (2,) is from touching a fixed hazard, at most; for plans."""

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


def ranks(values: Array) -> Array:
    """(n,) how many of `values` (n,) stand before each in ascending order; equals as they come.

    Counting is faster than a sort for short lists.
    """
    count = jnp.arange(len(values))
    ahead = (values[None, :] < values[:, None]) | (
        (values[None, :] == values[:, None]) & (count[None, :] < count[:, None])
    )
    return jnp.sum(ahead, axis=-1)


def packed(where: Array, chunk: int, spare: int) -> tuple[Array, Array]:
    """((m,) int32 indices of the marked places in ascending order, () int32 how many these are).

    Args:
        where: (n,) bool.
        chunk: m is n, rounded up to a multiple of it.
        spare: what follows the indices.
    """
    count = where.shape[0]
    size = -(-count // chunk) * chunk
    rank = jnp.cumsum(where.astype(jnp.int32))
    slot = jnp.where(where, rank - 1, size)
    order = jnp.full(size, spare, jnp.int32)
    order = order.at[slot].set(jnp.arange(count, dtype=jnp.int32), mode="drop")
    return order, rank[-1]


def renew(where: Array, rows: Any, make: Callable[[Array], Any], chunk: int = 16) -> Any:
    """Replaces the rows of a batch that are marked, computing only those.

    Args:
        where: (B,) bool, the rows to replace.
        rows: pytree with leading axis (B,).
        make: maps indices (chunk,) to new rows with leading axis (chunk,). It is called as often
            as there are marked rows to make; an index of B marks a spare place.
        chunk: rows made at a time.
    """
    order, count = packed(where, chunk, where.shape[0])

    def some(carry):
        start, rows = carry
        indices = jax.lax.dynamic_slice(order, (start,), (chunk,))
        new = make(indices)
        rows = jax.tree.map(lambda old, now: old.at[indices].set(now, mode="drop"), rows, new)
        return start + chunk, rows

    return jax.lax.while_loop(lambda c: c[0] < count, some, (0, rows))[1]


def step_and_renew(
    env: Env,
    keys: Array,
    states: Any,
    actions: Array,
    params: Any,
    look: Callable[[Any], Any],
) -> tuple[tuple[Any, Any], tuple[Any, Any], Outcome]:
    """`auto_reset_step` that also looks at the states; at fresh starts only where they are needed.

    Args:
        env: the environment.
        keys: (B,) one per row; no row depends on another.
        states: leading axis (B,).
        actions: (B,) int, or (B, 2) where they are continuous.
        params: of the environment, unbatched.
        look: maps a batch of states, of any size, to a pytree of rows.

    Returns:
        (carried, reached, outcome); the first two are pairs (states, look(states)).
    """
    both = jax.vmap(jax.random.split)(keys)
    step = jax.vmap(env.step, (0, 0, 0, None))
    reached, outcome = step(both[:, 0], states, actions, params)

    def starts(rows: Array) -> Any:
        fresh = jax.vmap(env.reset, (0, None))(both.at[rows, 1].get(mode="clip"), params)
        return fresh, look(fresh)

    seen = (reached, look(reached))
    return renew(outcome.done, seen, starts), seen, outcome


def auto_reset_step(
    env: Env, keys: Array, states: Any, actions: Array, params: Any
) -> tuple[Any, Any, Outcome]:
    """A step of a batch that draws a fresh start wherever an episode has ended.

    Arguments are those of `step_and_renew`.

    Returns:
        (carried, reached, outcome): `carried` are the states to go on from, newly drawn after an
        end; `reached` are the states the step led to, terminal ones included.
    """
    carried, reached, outcome = step_and_renew(env, keys, states, actions, params, lambda _: ())
    return carried[0], reached[0], outcome
