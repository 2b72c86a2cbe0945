"""Frozen Lake (section 5.2, figures 2 and 3): a slippery grid with holes."""

from collections.abc import Sequence

import numpy as np

from rp_jax.tabular.cmdp import FiniteCMDP, from_table
from rp_jax.validate import number, one_of

MAP_8X8 = (
    "SFFFFFFF",
    "FFFFFFFF",
    "FFFHFFFF",
    "FFFFFHFF",
    "FFFHFFFF",
    "FHHFFFHF",
    "FHFFHFHF",
    "FFFHFFFG",
)
ACTIONS = ("left", "down", "right", "up")
MOVES = ((0, -1), (1, 0), (0, 1), (-1, 0))  # (rows down, columns to the right) of each action
HOLES = ("released", "paper")  # as in the code behind the published numbers, or as in the text


def frozen_lake(
    rows: Sequence[str] = MAP_8X8,
    *,
    holes: str = "released",
    horizon: int | None = 100,
    gamma: float = 1.0,
    beta: float = 1.0,
    slip: float = 2 / 3,
) -> FiniteCMDP:
    """Returns the lake as a CMDP, with reward 1 for arriving at the goal, which ends the episode.

    States are numbered along the rows; one more, the last, stands for the end of an episode.

    Args:
        rows: strings of the letters S (start, one or more), F (frozen), H (hole), G (goal) and
            # (wall).
        holes: "released": a hole cannot be left, and each step that begins or ends in one has
            danger 1, so that a fall costs what is left of the episode; "paper": falling has danger
            1 and ends the episode.
        horizon: number of steps, or None for the infinite horizon.
        gamma: discount of reward.
        beta: discount of danger.
        slip: probability of moving sideways instead, half of it to either side.

    Raises:
        ValueError: a row's length or a letter is wrong, or a number is out of range.
    """
    table, cells = transition_table(rows, holes=holes, slip=slip)
    starts = cells == "S"
    if not starts.any():
        raise ValueError("rows has no S; it must have a start")
    return from_table(
        table,
        danger=(cells == "H").astype(float),
        start=starts / starts.sum(),
        gamma=gamma,
        beta=beta,
        horizon=horizon,
    )


def transition_table(
    rows: Sequence[str], *, holes: str = "released", slip: float = 2 / 3
) -> tuple[dict[int, dict[int, list[tuple[float, int, float, bool]]]], np.ndarray]:
    """Returns the lake's transitions in gymnasium's form, and the letters of its cells.

    Args:
        rows: strings of letters, as for `frozen_lake`.
        holes: "released" or "paper", as for `frozen_lake`.
        slip: probability of moving sideways instead, half of it to either side.

    Returns:
        table[s][a], which lists (probability, next state, reward, ends the episode), and the
        letters (S,).

    Raises:
        ValueError: a row's length or a letter is wrong, or a number is out of range.
    """
    one_of("holes", holes, HOLES)
    number("slip", slip, least=0, most=1)
    if isinstance(rows, str) or not all(isinstance(row, str) for row in rows):
        raise ValueError(f"rows is {rows!r}; it must be a list of strings")
    if not rows or not rows[0] or any(len(row) != len(rows[0]) for row in rows):
        raise ValueError(f"rows has rows of lengths {[*map(len, rows)]}; they must be alike")
    cells = np.asarray([[*row] for row in rows])
    for letter in np.unique(cells):
        one_of("rows: letter", str(letter), "SFHG#")
    flat = cells.ravel()
    table: dict[int, dict[int, list[tuple[float, int, float, bool]]]] = {}
    for state, letter in enumerate(flat):
        table[state] = {}
        for action in range(len(ACTIONS)):
            if letter in "GH#":
                table[state][action] = [(1.0, state, 0.0, letter != "H" or holes == "paper")]
                continue
            table[state][action] = []
            sides = ((action - 1) % 4, slip / 2), (action, 1 - slip), ((action + 1) % 4, slip / 2)
            for move, probability in sides:
                arrival = _moved(cells, state, move)
                there = flat[arrival]
                ends = there == "G" or (there == "H" and holes == "paper")
                table[state][action].append((probability, arrival, float(there == "G"), ends))
    return table, flat


def _moved(cells: np.ndarray, state: int, move: int) -> int:
    """Returns the cell that a move leads to; the edge and walls stop it."""
    height, width = cells.shape
    row, column = divmod(state, width)
    down, right = MOVES[move]
    row, column = np.clip(row + down, 0, height - 1), np.clip(column + right, 0, width - 1)
    return state if cells[row, column] == "#" else int(row * width + column)
