"""An earlier run's rows, to compare with."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.measure import Row

Key = tuple[str, str, int]  # name, unit, batch


def key_of(row: Row) -> Key:
    """Returns what a row has in common with the same one of another run."""
    return row.name, row.unit, row.batch


def earlier(path: Path, names: Sequence[str]) -> dict[Key, float]:
    """Units per second of an earlier run, by row.

    Args:
        path: a JSON file that a benchmark wrote, or a folder of such files.
        names: of the benchmarks that will be compared; of a folder, only their files are read.

    Raises:
        ValueError: there is no such file, or it is not a benchmark's.
    """
    files = [path]
    if path.is_dir():
        files = [file for name in names if (file := path / f"{name}.json").is_file()]
        if not files:
            wanted = ", ".join(f"{name}.json" for name in names)
            raise ValueError(f"against is {path}; the folder must hold one of {wanted}")
    found: dict[Key, float] = {}
    for file in files:
        found |= _rows(file)
    return found


def _rows(file: Path) -> dict[Key, float]:
    try:
        value = json.loads(file.read_text())
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"against is {file}; it cannot be read as JSON ({error})") from None
    rows = value.get("rows") if isinstance(value, Mapping) else None
    if not isinstance(rows, list):
        raise ValueError(f"against is {file}; it must be a benchmark's JSON, with a list of rows")
    return dict(_entry(row, f"against is {file}; row {i}") for i, row in enumerate(rows))


def _entry(row: Any, place: str) -> tuple[Key, float]:
    kinds: dict[str, Any] = {"name": str, "unit": str, "batch": int, "per_second": (int, float)}
    for field, kind in kinds.items():
        value = row.get(field) if isinstance(row, Mapping) else None
        if not isinstance(value, kind) or isinstance(value, bool):
            wanted = "text" if kind is str else "an integer" if kind is int else "a number"
            raise ValueError(f"{place}: {field} is {value!r}; it must be {wanted}")
    if not row["per_second"] > 0:
        raise ValueError(f"{place}: per_second is {row['per_second']!r}; it must be above 0")
    return (row["name"], row["unit"], row["batch"]), float(row["per_second"])
