"""What an experiment shows on the terminal: progress with an estimate of the time left, tables."""

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
from rich.table import Table

WIDE = 160  # columns of a file or a pipe, which has none of its own: no table is cut short

console = Console(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else WIDE)


def say(text: str, style: str | None = None) -> None:
    """Prints a line as it is: brackets in it are no markup."""
    console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


class Bar:
    """One stage's progress bar; call it with what is done and anything worth saying."""

    def __init__(self, progress: Progress, name: str):
        self._progress, self._name, self._stage = progress, name, ""
        self._task: TaskID | None = None

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Shows that `done` of `total` of `stage` are done; a new stage gets a bar of its own."""
        if stage != self._stage or self._task is None:
            label = f"{self._name}: {stage}" if stage else self._name
            self._task = self._progress.add_task(label, total=total, note="")
            self._stage = stage
        self._progress.update(self._task, completed=done, total=total, note=note)


@contextmanager
def progress(name: str) -> Iterator[Bar]:
    """A bar with elapsed and remaining time."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=12),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=console) as bars:
        yield Bar(bars, name)


def show(value: Any) -> str:
    """A table cell."""
    if isinstance(value, bool) or not isinstance(value, float):
        return str(value)
    if math.isnan(value):
        return "-"
    return f"{value:.4f}" if abs(value) < 1 else f"{value:.2f}"


def table(title: str, rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> None:
    """Prints rows under their column names."""
    grid = Table(title=title, title_justify="left")
    for column in columns:
        grid.add_column(column.replace("_", " "), justify="right")
    for row in rows:
        grid.add_row(*(show(row[column]) for column in columns))
    console.print(grid)
