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


def told(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns the same rows, variants in plain words."""
    plain = [{"variant": variant(row["variant"])} if "variant" in row else {} for row in rows]
    return [{**row, **words} for row, words in zip(rows, plain, strict=True)]
