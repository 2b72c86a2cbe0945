"""Reports on benchmarks: a table, a JSON file, and ratios to an earlier run."""

import argparse
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax

import rp_jax
from benchmarks.bound import Bound, limits
from benchmarks.compare import Key, earlier, key_of
from benchmarks.measure import Row, in_processes
from rp_jax import storage
from rp_jax.cli import terminal
from rp_jax.validate import number

OUT = Path("results/benchmarks")


def machine() -> dict[str, Any]:
    """Returns facts on the machine and the versions of what was measured."""
    return {
        "device": jax.devices()[0].device_kind,
        "platform": jax.default_backend(),
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "rp_jax": rp_jax.__version__,
        "limits": limits()._asdict(),
    }


def short(number: float) -> str:
    """Three digits and k, M or G."""
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if number >= size:
            return f"{number / size:.3g}{unit}"
    return f"{number:.3g}"


def _what(row: Row, same: bool) -> dict[str, str]:
    return {"what": row.name if same else f"{row.name} ({row.unit})", "batch": str(row.batch)}


def _speed(row: Row, same: bool, before: Mapping[Key, float]) -> dict[str, str]:
    """A line of the first table."""
    cells = _what(row, same)
    cells[f"{row.unit} / s" if same else "per second"] = short(row.per_second)
    if before:
        old = before.get(key_of(row))
        cells["x earlier"] = "-" if old is None else f"{row.per_second / old:.2f}"
    program = "-" if row.program_mib is None else f"{row.program_mib:,.1f}"
    return cells | {
        "spread": f"{short(row.slowest)} .. {short(row.fastest)}",
        "compile s": f"{row.compile_seconds:.2f}",
        "program MiB": program,
        "peak MiB": f"{row.peak_mib:,.0f}",
    }


def _limits(row: Row, bound: Bound, same: bool) -> dict[str, str]:
    """A line of the second table."""
    return _what(row, same) | {
        "operations": short(bound.operations),
        "bytes": short(bound.bytes),
        "of matrix rate": f"{100 * bound.arithmetic:.2g} %",
        "of copy rate": f"{100 * bound.memory:.2g} %",
        "limit": bound.limit,
    }


def _print(name: str, rows: Sequence[Row], before: Mapping[Key, float]) -> None:
    same = len({row.unit for row in rows}) == 1
    speeds = [_speed(row, same, before) for row in rows]
    terminal.table(name, speeds, list(speeds[0]))
    bounds = [_limits(row, row.bound, same) for row in rows if row.bound]
    if bounds:
        best = limits()
        title = (
            f"{name}, of one unit; limits: {short(best.operations)} operations/s in a matrix "
            f"product, {short(best.bytes)} bytes/s in a copy"
        )
        terminal.table(title, bounds, list(bounds[0]))


def report(
    name: str,
    rows: Sequence[Row],
    out: Path,
    before: Mapping[Key, float] | None = None,
    processes: int = 1,
) -> None:
    """Prints the rows, and writes them as JSON.

    Args:
        name: of the benchmark, and of the file.
        rows: at least one.
        out: folder, created if missing.
        before: units per second of an earlier run, by row; adds a column of ratios.
        processes: that the rows are medians of.
    """
    _print(name, rows, before or {})
    out.mkdir(parents=True, exist_ok=True)
    found = {"machine": machine(), "processes": processes, "rows": [asdict(r) for r in rows]}
    storage.write_json(out / f"{name}.json", found)


def command_line(program: str, benchmarks: Mapping[str, Callable[[], list[Row]]]) -> None:
    """Runs and reports benchmarks, by name; all that was given is read before.

    Args:
        program: as it is called.
        benchmarks: by name.
    """
    parser = argparse.ArgumentParser(prog=program)
    parser.add_argument("--out", type=Path, default=OUT, help=f"folder for the JSON ({OUT})")
    parser.add_argument(
        "--against", type=Path, help="JSON of an earlier run, or a folder of them, to compare with"
    )
    parser.add_argument(
        "--processes", type=int, default=3, help="how many, anew, to take medians over"
    )
    given = parser.parse_args()
    before = {}
    try:
        number("processes", given.processes, least=1, integer=True)
        if given.against is not None:
            before = earlier(given.against, list(benchmarks))
    except ValueError as error:
        parser.error(str(error))
    for name, run in benchmarks.items():
        rows = run() if given.processes == 1 else in_processes(run, given.processes)
        report(name, rows, given.out, before, given.processes)


def main(name: str, run: Callable[[], list[Row]]) -> None:
    """The command line of one benchmark."""
    command_line(f"python -m benchmarks.{name}", {name: run})
