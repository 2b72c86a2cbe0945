"""Names of tasks, tests and methods in plain words, as titles and legends have them."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

TASKS = {"circuit": "Circuit", "jam": "Jam", "point_gather": "Point Gather"}
LAKES = {"paper": "falling ends the episode", "released": "a step in a hole costs 1"}
TRACKS = {"default": "track of learning", "narrowed": "narrowed track", "circle": "circular track"}


def counted(count: int, noun: str) -> str:
    """Returns a number of things, such as 1 seed or 10 seeds."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def variant(name: str) -> str:
    """Returns what a test is called, such as 8 obstacles for N=8."""
    if obstacles := re.fullmatch(r"N=(\d+)", name):
        return counted(int(obstacles[1]), "obstacle")
    if lake := re.fullmatch(r"T=(\d+), (paper|released) holes", name):
        return f"{counted(int(lake[1]), 'step')}, {LAKES[lake[2]]}"
    return TRACKS.get(name, name)


def method(name: str) -> str:
    """Returns what a method is called, with a plural only where there are several steps."""
    return name.replace("(1 steps)", "(1 step)")


def told(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns the same rows, variants and methods in plain words."""
    words = {"variant": variant, "method": method}
    return [{**row, **{k: say(row[k]) for k, say in words.items() if k in row}} for row in rows]
