"""Figure 4: Jam, the threat of one obstacle, and sums over all of them."""

import shutil
from pathlib import Path
from typing import Any

from experiments.paper.scores import ERRORS, errors, read
from experiments.paper.section import Section, Table

TITLE = "Figure 4: Jam and its threats"
PICTURES = {
    "animation.gif": "(a) The room, and the threat of each action; inadmissible ones are crossed.",
    "figures/threat_of_one_obstacle.png": "(b) One obstacle: least threat over the actions, with "
    "the obstacle at each place, seen from the agent.",
    "figures/threat_of_all.png": "(c), (d) Sums over obstacles and walls, with the agent at each "
    "place, for two velocities.",
    "figures/trajectories.png": "Twenty episodes of the first agent.",
}


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """The threat models' errors on fresh states; keeps the pictures that the run drew."""
    jam = sources("jam")
    for name in PICTURES:
        shutil.copyfile(jam / name, folder / Path(name).name)
    return read(jam / "threat" / "report.json")


def tell(results: list[dict[str, Any]]) -> Section:
    """How well the threat is known."""
    return Section(
        "Threats were learned in sub-R-MDPs with one hazard; sums are upper bounds (Theorem 3).",
        tables=[Table(ERRORS, [errors(row) for row in results])],
        figures={Path(name).name: caption for name, caption in PICTURES.items()},
    )
