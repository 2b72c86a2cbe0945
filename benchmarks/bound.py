"""How far a program is from what the machine could do: its work over measured limits."""

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.stages import Lowered

COPIED = 2**26  # floats, 256 MiB: far larger than caches
SIDE = 2048  # of the matrices multiplied
NEAR = 0.5  # share of a limit from which on it is called the limit


class Piece(NamedTuple):
    """Part of a program: a function without loops, and how often a call of the program runs it."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    turns: float = 1.0


class Work(NamedTuple):
    """The work of a call of a program."""

    operations: float  # arithmetic ones, of floats and integers alike
    bytes: float  # read and written


class Limits(NamedTuple):
    """The limits of this machine."""

    operations: float  # per second, in a float32 matrix product
    bytes: float  # per second, read and written, in a copy in place


@dataclass(frozen=True)
class Bound:
    """One unit's work, and which share of each limit is reached."""

    operations: float  # of a unit
    bytes: float  # of a unit
    arithmetic: float  # share of the matrix rate
    memory: float  # share of the copy bandwidth; above 1 where caches serve
    limit: str  # "memory", "arithmetic", "caches", or "neither": dispatch, or one after another


def counted(lowered: Lowered, compiled: Any) -> Work:
    """The work of a compiled program, from XLA's cost analysis.

    Operations are those of the compiled program, with all that fusion computes twice; exponentials
    and the like count as one. The bytes are an upper estimate, the smaller one of two: as written,
    every intermediate result goes to memory and back; as compiled, fused ones do not, but a table
    counts as a whole wherever something is looked up in it.

    The body of a loop (`scan`, `while_loop`, `lax.map`) is counted once, however often it runs.
    """
    after, before = compiled.cost_analysis(), lowered.cost_analysis() or {}
    operations = after.get("flops", 0.0) + after.get("transcendentals", 0.0)
    moved = [costs["bytes accessed"] for costs in (before, after) if "bytes accessed" in costs]
    return Work(operations, min(moved, default=0.0))


def work_of(pieces: Sequence[Piece]) -> Work:
    """The work of a program with loops: that of its pieces, as often as each is run.

    A piece is usually the same program with its loop one turn long. What loops *inside* a piece,
    and so counts once, makes the sum an estimate from below.
    """
    operations = moved = 0.0
    for piece in pieces:
        lowered = jax.jit(piece.function).lower(*piece.arguments)
        work = counted(lowered, lowered.compile())
        operations += piece.turns * work.operations
        moved += piece.turns * work.bytes
    return Work(operations, moved)


def _fastest(function: Callable[[Array], Array], argument: Array, calls: int) -> float:
    """Seconds of the fastest call; each is given what the one before returned."""
    compiled = jax.jit(function, donate_argnums=0).lower(argument).compile()
    seconds = []
    for _ in range(calls):
        began = time.perf_counter()
        argument = jax.block_until_ready(compiled(argument))
        seconds.append(time.perf_counter() - began)
    return min(seconds)


@functools.cache
def limits() -> Limits:
    """This machine's copy bandwidth and matrix rate, measured once per process (a few seconds).

    The fastest of ten calls each: whatever else runs can only slow them.
    """
    copy = _fastest(lambda x: x + 1, jnp.zeros(COPIED, jnp.float32), 10)
    start = jnp.full((SIDE, SIDE), 1 / SIDE, jnp.float32)
    product = _fastest(lambda x: x @ x, start, 10)
    return Limits(operations=2 * SIDE**3 / product, bytes=2 * 4 * COPIED / copy)


def bound(work: Work, count: float, per_second: float) -> Bound:
    """Where a program stands.

    Args:
        work: of a call.
        count: units that a call gets done.
        per_second: units.
    """
    best = limits()
    operations, moved = work.operations / count, work.bytes / count
    arithmetic = operations * per_second / best.operations
    memory = moved * per_second / best.bytes
    return Bound(operations, moved, arithmetic, memory, named(arithmetic, memory))


def named(arithmetic: float, memory: float) -> str:
    """The limit that is near, by the shares reached of both."""
    if max(arithmetic, memory) < NEAR:
        return "neither"
    if arithmetic >= min(memory, 1.0):
        return "arithmetic"
    # More than memory could move: the count is too high, or caches hold what moves.
    return "memory" if memory <= 1.0 else "caches"
