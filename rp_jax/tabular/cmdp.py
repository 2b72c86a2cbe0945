"""Finite constrained MDPs (equations 1 and 2) as arrays.

They have S states and A actions. H is the length of the time axis: the horizon T, or 1 for the
infinite horizon, where everything is stationary.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from rp_jax.validate import number

ROUNDING = 1e-6  # greatest error of a sum of probabilities; they are divided by their sum


class FiniteCMDP(struct.PyTreeNode):
    """A finite CMDP (S, A, r, d, P, P_0) with discounts and horizon; to be built by `make`."""

    transition: Array  # (S, A, S) probabilities P(s' | s, a)
    reward: Array  # (S, A) expected reward r(s, a)
    danger: Array  # (S, A) expected danger d(s, a) >= 0
    start: Array  # (S,) distribution P_0 of the first state
    gamma: Array  # () discount of reward, in [0, 1]
    beta: Array  # () discount of danger, in [0, 1]
    horizon: int | None = struct.field(pytree_node=False)  # number of steps T; None: infinite

    @property
    def shape(self) -> tuple[int, int, int]:
        """The shape (H, S, A) of time-indexed threats and policies."""
        states, actions = self.reward.shape
        return self.horizon or 1, states, actions


def make(
    transition: Any,
    reward: Any,
    danger: Any,
    start: Any,
    *,
    gamma: float,
    beta: float,
    horizon: int | None,
) -> FiniteCMDP:
    """Returns a finite CMDP, checked.

    Args:
        transition: (S, A, S) probabilities; rows sum to 1.
        reward: (S, A), or (S, A, S) where it depends on the next state.
        danger: (S, A) or (S, A, S), at least 0.
        start: (S,) distribution of the first state, or the index of the only one.
        gamma: discount of reward, in [0, 1]; below 1 for the infinite horizon.
        beta: discount of danger, in [0, 1]; below 1 for the infinite horizon.
        horizon: number of steps, or None for the infinite horizon.

    Raises:
        ValueError: an argument is out of range; the message names it.
    """
    kernel = array_of("transition", transition)
    if kernel.ndim != 3 or kernel.shape[0] != kernel.shape[2] or kernel.size == 0:
        raise ValueError(f"transition has shape {kernel.shape}; it must be (S, A, S), not empty")
    states, actions, _ = kernel.shape
    kernel = distribution("transition", kernel)
    first = _first(start, states)
    signals = {}
    for name, value in {"reward": reward, "danger": danger}.items():
        signal = array_of(name, value)
        if signal.shape not in {(states, actions), (states, actions, states)}:
            raise ValueError(
                f"{name} has shape {signal.shape}; it must be ({states}, {actions}) or "
                f"({states}, {actions}, {states})"
            )
        signals[name] = signal
    if signals["danger"].min() < 0:
        raise ValueError(f"danger has the value {signals['danger'].min()}; it must be at least 0")
    for name, signal in signals.items():
        if signal.ndim == 3:
            signals[name] = (kernel * signal).sum(axis=2)
    for name, discount in {"gamma": gamma, "beta": beta}.items():
        number(name, discount, least=0, most=1)
        if horizon is None and jnp.asarray(discount, float) == 1:
            kind = jnp.asarray(0.0).dtype
            raise ValueError(
                f"{name} is {discount}; as {kind} it must be below 1 for the infinite horizon"
            )
    if horizon is not None:
        number("horizon", horizon, least=1, integer=True)
    return FiniteCMDP(
        transition=jnp.asarray(kernel),
        reward=jnp.asarray(signals["reward"]),
        danger=jnp.asarray(signals["danger"]),
        start=jnp.asarray(first),
        gamma=jnp.asarray(gamma, float),
        beta=jnp.asarray(beta, float),
        horizon=None if horizon is None else int(horizon),
    )


def from_table(
    table: Mapping[int, Mapping[int, Sequence[tuple[float, int, float, bool]]]],
    danger: Any,
    start: Any,
    *,
    gamma: float,
    beta: float,
    horizon: int | None,
) -> FiniteCMDP:
    """Returns a CMDP from a transition table like those of gymnasium's toy-text environments.

    The probabilities of a successor that is listed several times are added up. A step that ends the
    episode gives its reward and leads to an additional state, the last one, which has no reward and
    no danger.

    Args:
        table: table[s][a] lists (probability, next state, reward, ends the episode).
        danger: (S,) danger of arriving in each state.
        start: (S,) distribution of the first state, or the index of the only one, without the
            additional state.
        gamma: discount of reward, in [0, 1]; below 1 for the infinite horizon.
        beta: discount of danger, in [0, 1]; below 1 for the infinite horizon.
        horizon: number of steps, or None for the infinite horizon.

    Raises:
        ValueError: the table has gaps, or an argument is out of range.
    """
    try:
        states, actions = len(table), len(table[0])
        moves = {
            (s, a): [(float(p), z, float(r), bool(e)) for p, z, r, e in table[s][a]]
            for s in range(states)
            for a in range(len(table[s]))
        }
    except (KeyError, IndexError, TypeError, ValueError):
        raise ValueError(
            "table is no table; table[s][a], of states s and actions a from 0 on, must list "
            "(probability, next state, reward, ends the episode)"
        ) from None
    if len(moves) != states * actions or any(len(table[s]) != actions for s in range(states)):
        raise ValueError(
            f"table has states with other than {actions} actions; all must have as many"
        )
    arriving = array_of("danger", danger)
    if arriving.shape != (states,):
        raise ValueError(f"danger has shape {arriving.shape}; it must be ({states},)")
    if arriving.min() < 0:
        raise ValueError(f"danger has the value {arriving.min()}; it must be at least 0")
    end = states
    kernel = np.zeros((states + 1, actions, states + 1))
    earned, harm = np.zeros((2, states + 1, actions))
    kernel[end, :, end] = 1.0
    for (state, action), successors in moves.items():
        where = f"table[{state}][{action}]"
        for probability, arrival, reward, ends in successors:
            number(f"{where}: next state", arrival, least=0, most=states - 1, integer=True)
            number(f"{where}: probability", probability, least=0, most=1)
            kernel[state, action, end if ends else arrival] += probability
            earned[state, action] += probability * reward
            harm[state, action] += probability * arriving[arrival]
    first = np.append(_first(start, states), 0.0)
    return make(kernel, earned, harm, first, gamma=gamma, beta=beta, horizon=horizon)


def _first(start: Any, states: int) -> np.ndarray:
    """Returns the distribution of the first state (S,), given as such or as an index."""
    if isinstance(start, int | np.integer) and not isinstance(start, bool):
        number("start", int(start), least=0, most=states - 1, integer=True)
        return np.eye(states)[start]
    first = array_of("start", start)
    if first.shape != (states,):
        raise ValueError(f"start has shape {first.shape}; it must be ({states},)")
    return distribution("start", first)


def array_of(name: str, value: Any) -> np.ndarray:
    """Returns an array in float64 whose values are finite also in the precision that JAX uses.

    Args:
        name: name of the array, for the message.
        value: numbers, nested in sequences or arrays.

    Raises:
        ValueError: the value is not an array of real numbers, or has one that is not finite.
    """
    try:
        array = np.asarray(value)
        if np.iscomplexobj(array):
            raise TypeError
        array = array.astype(np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is no array of numbers") from None
    if not (np.abs(array) <= float(jnp.finfo(jnp.zeros(()).dtype).max)).all():
        raise ValueError(f"{name} has a value that is not finite")
    return array


def distribution(name: str, array: np.ndarray) -> np.ndarray:
    """Returns probabilities divided by their sums, checked.

    Args:
        name: name of the array, for the message.
        array: (..., n) probabilities, whose sum over the last axis must be 1 up to rounding.

    Raises:
        ValueError: a probability is negative, or a sum is not 1.
    """
    if array.min() < 0:
        raise ValueError(f"{name} has the probability {array.min()}; it must be at least 0")
    total = array.sum(axis=-1, keepdims=True)
    worst = np.abs(total - 1).argmax()
    if abs(total.flat[worst] - 1) > ROUNDING:
        row = np.unravel_index(worst, total.shape)[:-1]
        where = f"{name}[{', '.join(map(str, row))}]" if row else name
        raise ValueError(f"{where} sums to {total.flat[worst]}; it must sum to 1")
    return array / total
