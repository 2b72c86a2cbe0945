"""Figure 2: Frozen Lake, the action threat of the optimal R-MDP policy."""

from pathlib import Path
from typing import Any

from experiments import frozen_lake
from experiments.paper.scores import read
from experiments.paper.section import Claim, Section, holds

TITLE = "Figure 2: threats on Frozen Lake"
RIGHT = 2  # action
NARROW = ((6, 8), (7, 8))  # rows and columns, counted from 1, where only RIGHT is safe


def run(sources: Any, folder: Path) -> dict[str, Any]:
    """The map and its threats; exact."""
    return read(sources("frozen_lake") / "optima.json")["map"]


def plot(results: dict[str, Any], folder: Path) -> None:
    """The threat of each action on the map."""
    frozen_lake.plot_map(results, folder / "figure_2.png")


def tell(results: dict[str, Any]) -> Section:
    """Returns the section: what the text of section 5.2 says about the figure."""
    threat = results["threat"]  # (actions, rows, columns)
    down_the_edge = [threat[RIGHT][row][-1] for row in range(len(results["rows"]))]
    others = {
        place: min(threat[a][place[0] - 1][place[1] - 1] for a in range(len(threat)) if a != RIGHT)
        for place in NARROW
    }
    near, far = _by_distance(results["rows"], threat)
    return Section(
        f"Exact, {results['horizon']} steps, falling ends the episode.",
        claims=[
            Claim(
                "Figure 2: a safe path from S to G follows the rightmost column",
                "safe",
                f"threat of RIGHT along it: at most {max(down_the_edge):g}",
                holds(max(down_the_edge) == 0),
            ),
            Claim(
                "Figure 2: at (6, 8) and (7, 8) only RIGHT is safe",
                "only RIGHT",
                ", ".join(f"{p}: other actions at least {t:.2f}" for p, t in others.items()),
                holds(min(others.values()) > 0),
            ),
            Claim(
                "Figure 2: threats are higher closer to holes",
                "higher",
                f"mean threat {near:.3f} beside a hole, {far:.3f} elsewhere",
                holds(near > far),
            ),
        ],
        figures={"figure_2.png": "The threat of each action; 0 where marked."},
    )


def _by_distance(rows: list[str], threat: list) -> tuple[float, float]:
    """Mean threat over actions and free cells: beside a hole, and elsewhere."""
    values: dict[bool, list[float]] = {True: [], False: []}
    for i, row in enumerate(rows):
        for j, letter in enumerate(row):
            if letter == "H":
                continue
            around = [(i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)]
            inside = [(a, b) for a, b in around if 0 <= a < len(rows) and 0 <= b < len(row)]
            beside = any(rows[a][b] == "H" for a, b in inside)
            values[beside] += [of[i][j] for of in threat]
    near, far = (sum(of) / len(of) for of in (values[True], values[False]))
    return near, far
