"""How a benchmark is taken: compile time apart, the median of repeats with their spread."""

import argparse
import os
import platform
import resource
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax

import rp_jax
from experiments import console
from rp_jax import storage


@dataclass(frozen=True)
class Row:
    """One measured program."""

    name: str
    unit: str  # what `per_second` counts
    batch: int
    per_second: float  # median
    slowest: float
    fastest: float
    compile_seconds: float
    peak_mib: float  # of the process so far


def measure(
    name: str,
    unit: str,
    batch: int,
    count: float,
    function: Callable[..., Any],
    *arguments: Any,
    repeats: int = 5,
    carried: bool = False,
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
    """
    began = time.perf_counter()
    given = (0,) if carried else ()
    compiled = jax.jit(function, donate_argnums=given).lower(*arguments).compile()
    compile_seconds = time.perf_counter() - began
    rates = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        result = jax.block_until_ready(compiled(*arguments))
        rates.append(count / (time.perf_counter() - began))
        if carried:
            arguments = (result[0], *arguments[1:])
    rates = rates[1:]  # the first call warms up
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return Row(
        name, unit, batch, statistics.median(rates), min(rates), max(rates), compile_seconds, peak
    )


def machine() -> dict[str, Any]:
    """What was measured on, and with what."""
    return {
        "device": jax.devices()[0].device_kind,
        "platform": jax.default_backend(),
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "rp_jax": rp_jax.__version__,
    }


def _short(number: float) -> str:
    """Three digits and k, M or G."""
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if number >= size:
            return f"{number / size:.3g}{unit}"
    return f"{number:.3g}"


def report(name: str, rows: Sequence[Row], out: Path | None) -> None:
    """Prints the rows, and writes them as JSON if `out` is given."""
    same = len({row.unit for row in rows}) == 1
    shown = [
        {
            "what": row.name if same else f"{row.name} ({row.unit})",
            "batch": row.batch,
            f"{row.unit} / s" if same else "per second": _short(row.per_second),
            "spread": f"{_short(row.slowest)} .. {_short(row.fastest)}",
            "compile s": f"{row.compile_seconds:.2f}",
            "peak MiB": f"{row.peak_mib:,.0f}",
        }
        for row in rows
    ]
    console.table(name, shown, list(shown[0]))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        rows_json = [asdict(row) for row in rows]
        storage.write_json(out / f"{name}.json", {"machine": machine(), "rows": rows_json})


def main(name: str, run: Callable[[], list[Row]]) -> None:
    """The command line of one benchmark."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{name}")
    parser.add_argument("--out", type=Path, help="folder for the JSON")
    out = parser.parse_args().out
    report(name, run(), out)
