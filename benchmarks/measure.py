"""How a benchmark is taken: compile time apart, the median of repeats with their spread."""

import dataclasses
import multiprocessing
import resource
import statistics
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax

from benchmarks.bound import Bound, Piece, bound, counted, work_of


@dataclass(frozen=True)
class Row:
    """One measured program."""

    name: str
    unit: str  # what `per_second` counts
    batch: int
    per_second: float  # median over calls, then over processes
    slowest: float  # of the processes; of the calls, if there was one process
    fastest: float
    compile_seconds: float
    peak_mib: float  # of the process so far
    program_mib: float | None = None  # the program's arguments, results and scratch memory
    bound: Bound | None = None  # None where Python drives


def peak_mib() -> float:
    """The most memory that this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def row_of(name: str, unit: str, batch: int, rates: Sequence[float]) -> Row:
    """A row of rates that Python took, with nothing compiled."""
    middle = statistics.median(rates)
    return Row(name, unit, batch, middle, min(rates), max(rates), 0.0, peak_mib())


def measure(
    name: str,
    unit: str,
    batch: int,
    count: float,
    function: Callable[..., Any],
    *arguments: Any,
    repeats: int = 5,
    carried: bool = False,
    pieces: Sequence[Piece] | None = None,
) -> Row:
    """Compiles `function`, runs it once to warm up, then `repeats` times.

    Args:
        name: of the row.
        unit: what is counted.
        batch: rows side by side.
        count: units that one call gets done.
        function: to be jitted; its result is waited for.
        *arguments: of the call.
        repeats: timed calls.
        carried: the first result is the next call's first argument, and its memory is given away.
        pieces: whose work is that of a call; needed where `function` loops (`bound.work_of`).
    """
    began = time.perf_counter()
    lowered = jax.jit(function, donate_argnums=(0,) if carried else ()).lower(*arguments)
    compiled = lowered.compile()
    compile_seconds = time.perf_counter() - began
    work = counted(lowered, compiled) if pieces is None else work_of(pieces)
    rates = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        result = jax.block_until_ready(compiled(*arguments))
        rates.append(count / (time.perf_counter() - began))
        if carried:
            arguments = (result[0], *arguments[1:])
    row = row_of(name, unit, batch, rates[1:])  # the first call warms up
    return dataclasses.replace(
        row,
        compile_seconds=compile_seconds,
        program_mib=_program_mib(compiled),
        bound=bound(work, count, row.per_second),
    )


def middle(rows: Sequence[Row]) -> Row:
    """The row of median speed of the same program's in several processes, with their spread."""
    rows = sorted(rows, key=lambda row: row.per_second)
    return dataclasses.replace(
        rows[(len(rows) - 1) // 2],
        slowest=rows[0].per_second,
        fastest=rows[-1].per_second,
        compile_seconds=statistics.median(row.compile_seconds for row in rows),
        peak_mib=max(row.peak_mib for row in rows),
    )


def in_processes(run: Callable[[], list[Row]], processes: int) -> list[Row]:
    """Rows of a benchmark run anew in so many processes, one after another.

    Calls within a process agree where processes do not: two of the same program, minutes apart on
    a quiet machine, may differ by a factor of two.

    Args:
        run: the benchmark, a function of a module.
        processes: how many.
    """
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, max_tasks_per_child=1) as pool:
        found = [pool.submit(run).result() for _ in range(processes)]
    return [middle(rows) for rows in zip(*found, strict=True)]


def recount(row: Row, unit: str, factor: float) -> Row:
    """Returns a measurement in another unit, `factor` of which make one of the row's."""
    work = row.bound and dataclasses.replace(
        row.bound, operations=row.bound.operations / factor, bytes=row.bound.bytes / factor
    )
    speeds = (factor * rate for rate in (row.per_second, row.slowest, row.fastest))
    middle, slowest, fastest = speeds
    return dataclasses.replace(
        row, unit=unit, per_second=middle, slowest=slowest, fastest=fastest, bound=work
    )


def _program_mib(compiled: Any) -> float:
    sizes = compiled.memory_analysis()
    parts = sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes
    return (parts - sizes.alias_size_in_bytes) / 2**20
