"""Pictures of the environments, as a new episode begins.

python -m experiments.figures.environments [FOLDER]   (default: docs/images)
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.figures import circuit_figures, jam_figures, point_gather_figures
from rp_jax.dynamics import Vehicle
from rp_jax.envs import circuit, jam, patrol, point_gather
from rp_jax.plot import scenes

SEED = 4


def poses(vehicles: Vehicle) -> list[scenes.Pose]:
    """Returns who is where.

    Args:
        vehicles: states, leading axis (n,).
    """
    pairs = zip(np.asarray(vehicles.position), np.asarray(vehicles.heading), strict=True)
    return [scenes.Pose(*pair) for pair in pairs]


def draw_all(folder: Path) -> list[Path]:
    """Draws a picture of each environment.

    Args:
        folder: where to write the PNGs; made if there is none.

    Returns:
        The files written.
    """
    key = jax.random.key(SEED)
    track, room, field = circuit.make_params(), jam.make_params(), point_gather.make_params()
    corners = jam_figures.scene_of(room)
    targets = [(np.asarray([c]), patrol.NEAR, scenes.GOOD) for c in patrol.CORNERS]
    circle, square = circuit.demo_start(track), jam.reset(key, room)
    wide = point_gather.reset(key, field)
    found: dict[str, tuple[scenes.Scene, Any, Callable[[Any], Vehicle] | None]] = {
        "circuit": (circuit_figures.scene_of(track.track), circle, None),
        "jam": (corners, square, jam_figures.present_obstacles),
        "patrol": (
            corners._replace(rings=targets, exit=None, goal=None),
            square,
            jam_figures.present_obstacles,
        ),
        "point_gather": (
            point_gather_figures.scene_of(wide)._replace(radius=0.35),
            wide,
            point_gather_figures.objects_left,
        ),
    }
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name, (scene, state, others) in found.items():
        bodies = poses(jax.tree.map(lambda a: a[None], state.body))
        path = folder / f"{name}.png"
        scenes.picture(scene, bodies + ([] if others is None else poses(others(state))), path)
        files.append(path)
    return files


def main(argv: list[str]) -> None:
    """Draws all pictures.

    Args:
        argv: the folder, or nothing.
    """
    for path in draw_all(Path(argv[0] if argv else "docs/images")):
        print(path)


if __name__ == "__main__":
    main(sys.argv[1:])
