"""Lines, tables, and progress with the time left, shown on the terminal."""

import functools
import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table as Grid
from rich.text import Text

from rp_jax.runs.progress import OnProgress

WIDE = 160  # columns of a file or a pipe, which has none of its own: no table is cut short


@functools.cache
def console() -> Console:
    """Returns the terminal, asked for when something is first shown."""
    wide = sys.stdout is None or not (sys.stdout.isatty() or "COLUMNS" in os.environ)
    return Console(width=WIDE if wide else None)


def say(text: str, style: str | None = None) -> None:
    """Prints a line as it is: brackets in it are no markup, and :car: is no picture.

    Args:
        text: the line.
        style: rich's name of a colour or style.
    """
    console().print(Text(text, style or ""), soft_wrap=True)


@contextmanager
def progress(name: str = "") -> Iterator[OnProgress]:
    """Shows a bar for each stage that is told of, with elapsed and remaining time.

    Args:
        name: before the names of the stages.

    Yields:
        What is called with (stage, done, total, note).
    """
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=12),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    with Progress(*columns, console=console()) as bars:
        tasks: dict[str, TaskID] = {}

        def tell(stage: str, done: int, total: int, note: str = "") -> None:
            if stage not in tasks:
                label = f"{name}: {stage}" if name and stage else name or stage
                tasks[stage] = bars.add_task(label, total=total, note="")
            bars.update(tasks[stage], completed=done, total=total, note=note)

        yield tell


def cell(value: Any) -> str:
    """Returns a value as a cell of a table.

    Args:
        value: anything; numbers are rounded, and nan is a dash.
    """
    if isinstance(value, bool) or not isinstance(value, float):
        return str(value)
    if math.isnan(value):
        return "-"
    return f"{value:.4f}" if abs(value) < 1 else f"{value:.2f}"


def table(title: str, rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> None:
    """Prints rows under the names of their columns, all texts as they are: nothing is markup.

    Args:
        title: above the table.
        rows: (n,) cells by column.
        columns: in this order.
    """
    grid = Grid(title=Text(title), title_justify="left")
    for column in columns:
        grid.add_column(Text(column), justify="right")
    for row in rows:
        grid.add_row(*(Text(cell(row[column])) for column in columns))
    console().print(grid)
