"""Trajectories of vehicles, and animations of episodes with the threat of every action."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle, Wedge
from PIL import Image

matplotlib.use("Agg")
from matplotlib import pyplot as plt

AGENT, OBSTACLE, ZONE = "#d69e2e", "#63b3ed", "#c6f6d5"
NONE_BELOW = "\nnone is below: the least is taken"
GOOD, BAD = "#38a169", "#c53030"


class Scene(NamedTuple):
    """Everything that stands still, drawn below the rest."""

    walls: np.ndarray  # (w, 2) wall points, room units
    corners: Sequence[tuple[float, float]] = ()  # corners of the room with safety zones
    zone: float = 0.0  # side of the zones' squares, or their radius, room units
    round_zones: bool = False  # zones are quarter circles
    radius: float = 0.1  # radius of the vehicles, room units
    colours: Sequence[str] = ()  # colour of each obstacle, where they differ
    rings: Sequence[tuple[np.ndarray, float, str]] = ()  # (centres (n, 2), radius, colour)


class Episode(NamedTuple):
    """An episode step by step, up to its end."""

    position: np.ndarray  # (t, 2) room units
    heading: np.ndarray  # (t, 2) unit vectors
    obstacles: np.ndarray  # (t, n, 2) positions of the obstacles; n may be 0
    obstacle_headings: np.ndarray  # (t, n, 2) unit vectors
    action: np.ndarray  # (t,) int
    threat: np.ndarray  # (t, A) threats of the actions
    admissible: np.ndarray  # (t, A) bool
    secure: np.ndarray  # (t,) bool, some action's threat is at most the threshold
    hit: np.ndarray  # (t,) bool, the step that led here met danger


class Pose(NamedTuple):
    """Where a body is, and which way it looks."""

    position: Sequence[float]  # (2,) room units
    heading: Sequence[float]  # (2,) unit vector; nan where it has none


class Path2D(NamedTuple):
    """The part of an episode that `trajectories` draws."""

    position: np.ndarray  # (t, 2) room units
    hit: np.ndarray  # (t,) bool, the step that led here met danger


def draw_scene(axis: Any, scene: Scene) -> None:
    """Draws walls as dots, safety zones shaded, and rings.

    Args:
        axis: the matplotlib axes to draw on.
        scene: everything that stands still.
    """
    low, high = scene.walls.min(axis=0), scene.walls.max(axis=0)
    for corner in scene.corners:
        if scene.round_zones:
            inner = np.where(np.asarray(corner) == low, 0, 90)
            start = {(0, 0): 0, (90, 0): 90, (90, 90): 180, (0, 90): 270}[tuple(inner)]
            axis.add_patch(Wedge(corner, scene.zone, start, start + 90, color=ZONE, zorder=0))
        else:
            place = np.minimum(corner, high - scene.zone)
            axis.add_patch(Rectangle(place, scene.zone, scene.zone, color=ZONE, zorder=0))
    axis.plot(*scene.walls.T, ".", color="#2d3748", markersize=1.5, zorder=1)
    for places, radius, colour in scene.rings:
        for place in places:
            axis.add_patch(Circle(tuple(place), radius, fill=False, edgecolor=colour, zorder=1))
            axis.plot(*place, "o", color=colour, markersize=3, zorder=1)
    axis.set_aspect("equal")
    axis.set_xticks([])
    axis.set_yticks([])


def picture(scene: Scene, bodies: Sequence[Pose], path: Path, width: float = 2.0) -> None:
    """Draws one moment of a world, small.

    Args:
        scene: everything that stands still.
        bodies: who is where; the first one is the agent's.
        path: where to write the PNG.
        width: of the picture, inches.
    """
    low, high = scene.walls.min(axis=0) - 0.05, scene.walls.max(axis=0) + 0.05
    shape = float((high - low)[1] / (high - low)[0])
    figure, axis = plt.subplots(figsize=(width, width * shape), layout="constrained")
    draw_scene(axis, scene)
    axis.axis("off")
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    colours = [AGENT, *(scene.colours or [OBSTACLE] * (len(bodies) - 1))]
    for body, colour in zip(bodies, colours, strict=True):
        x, y = body.position
        axis.add_patch(Circle((x, y), scene.radius, color=colour, zorder=4))
        tip = np.asarray(body.position) + 1.8 * scene.radius * np.asarray(body.heading)
        axis.plot(*np.stack([body.position, tip]).T, color="black", linewidth=1.2, zorder=5)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def trajectories(
    panels: Sequence[tuple[str, Scene, Sequence[Episode | Path2D]]], path: Path
) -> None:
    """Draws the paths of several episodes per panel (figure 6).

    An S marks each start, a red cross each crash.

    Args:
        panels: (title, scene, episodes) of each panel.
        path: where to write the PNG.
    """
    columns = min(3, len(panels))
    lines = -(-len(panels) // columns)
    extents = [np.ptp(scene.walls, axis=0) for _, scene, _ in panels]
    shapes = [float(height / width) for width, height in extents]  # of the panels
    heights = [5 * max(shapes[i * columns : (i + 1) * columns]) + 0.3 for i in range(lines)]
    figure, axes = plt.subplots(
        lines,
        columns,
        figsize=(5 * columns, sum(heights)),
        height_ratios=heights,
        layout="constrained",
        squeeze=False,
    )
    for axis in axes.flat[len(panels) :]:
        axis.axis("off")
    for axis, (title, scene, episodes) in zip(axes.flat, panels, strict=False):
        draw_scene(axis, scene)
        crashes = 0
        for episode in episodes:
            dots = "." if len(episode.position) <= 20 else None  # short episodes have long steps
            axis.plot(*episode.position.T, marker=dots, color="#2b6cb0", alpha=0.6, linewidth=1)
            axis.annotate("S", episode.position[0], fontsize=8, ha="center", va="center")
            crashes += bool(episode.hit.any())
            axis.plot(*episode.position[episode.hit].T, "x", color=BAD, markersize=9, zorder=5)
        axis.set_title(f"{title}: {crashes} of {len(episodes)} episodes crashed", fontsize=10)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def animate(
    scene: Scene,
    episode: Episode,
    accelerations: Sequence[float],
    turns: Sequence[float],
    x: float,
    path: Path,
    on_progress: Callable[[int, int], None] | None = None,
    rows: str = "acceleration",
) -> None:
    """Writes an animated GIF: the world on the left, the threat of each action on the right.

    Inadmissible actions are crossed out, and the chosen one is framed.

    Args:
        scene: everything that stands still.
        episode: everything that moves.
        accelerations: accelerations of the action table, one row each.
        turns: turns of the action table, one column each, from right to left.
        x: the threshold.
        path: where to write the GIF.
        on_progress: called with (frames done, frames).
        rows: name of the quantity in the rows.
    """
    frames = len(episode.action)
    shape = (len(accelerations), len(turns))
    figure, (world, table) = plt.subplots(
        1, 2, figsize=(9, 4.4), width_ratios=(1.25, 1), layout="constrained"
    )
    draw_scene(world, scene)
    (trail,) = world.plot([], [], color=AGENT, linewidth=1)
    others = [
        world.add_patch(Circle((0, 0), scene.radius, color=colour))
        for colour in scene.colours or [OBSTACLE] * episode.obstacles.shape[1]
    ]
    body = world.add_patch(Circle((0, 0), scene.radius, color=AGENT, zorder=4))
    noses = [
        world.plot([], [], color="black", linewidth=1, zorder=5)[0] for _ in range(1 + len(others))
    ]
    # The strongest turn to the left is in the leftmost column, as the driver sees it.
    image = table.imshow(np.ones(shape), norm=LogNorm(1e-4, 1, clip=True), cmap="inferno")
    table.set_xticks(range(shape[1]), [f"{t:+.2f}" for t in turns[::-1]])
    table.tick_params(axis="x", labelrotation=0 if shape[1] <= 5 else 60)
    table.set_yticks(range(shape[0]), [f"{a:+.2f}" for a in accelerations])
    table.set_xlabel("turn, radians (left is positive)")
    table.set_ylabel(rows)
    figure.colorbar(image, ax=table, label="threat", shrink=0.7)
    crosses = [
        [table.text(j, i, "x", ha="center", va="center", color="white") for j in range(shape[1])]
        for i in range(shape[0])
    ]
    frame = table.add_patch(Rectangle((0, 0), 1, 1, fill=False, edgecolor="cyan", linewidth=3))

    def show(t: int) -> None:
        trail.set_data(*episode.position[: t + 1].T)
        body.center = episode.position[t]
        bodies = [(episode.position[t], episode.heading[t])]
        for k, patch in enumerate(others):
            patch.center = episode.obstacles[t, k]
            bodies.append((episode.obstacles[t, k], episode.obstacle_headings[t, k]))
        for nose, (where, way) in zip(noses, bodies, strict=True):
            tip = where + way * scene.radius * 1.4
            nose.set_data([where[0], tip[0]], [where[1], tip[1]])
        threat = episode.threat[t].reshape(shape)[:, ::-1]
        allowed = episode.admissible[t].reshape(shape)[:, ::-1]
        image.set_data(np.maximum(threat, 1e-4))
        for i in range(shape[0]):
            for j in range(shape[1]):
                crosses[i][j].set_visible(not allowed[i, j])
        row, column = divmod(int(episode.action[t]), shape[1])
        frame.set_xy((shape[1] - 1 - column - 0.5, row - 0.5))
        state = "" if episode.secure[t] else NONE_BELOW
        told.set_text(f"crossed: threat above {x:g}{state}")
        clock.set_text(f"step {t}" + (", CRASH" if episode.hit[t] else ""))

    # The longest titles come first, so that the layout leaves room for them.
    told = table.set_title(f"crossed: threat above {x:g}{NONE_BELOW}", fontsize=10)
    clock = world.set_title("step 0")
    flat = [cross for row in crosses for cross in row]
    moving = [trail, *others, body, *noses, image, frame, *flat, clock, told]
    pictures = []
    for t, picture in enumerate(_pictures(figure, moving, show, frames)):
        pictures.append(picture)
        if on_progress:
            on_progress(t + 1, frames)
    plt.close(figure)
    pause = 83 if frames > 20 else 333  # milliseconds for a frame
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=pause, loop=0)


def _pictures(
    figure: Figure, moving: Sequence[Artist], show: Callable[[int], None], count: int
) -> Iterator[Image.Image]:
    """Draws a figure again and again; what stands still, and the layout, only once.

    Args:
        figure: with all its artists.
        moving: the artists that change, from back to front.
        show: changes them to those of a given frame.
        count: number of frames.

    Yields:
        The frames, all with the colours of the first.
    """
    figure.set_dpi(80)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    figure.set_layout_engine("none")
    for artist in moving:
        artist.set_animated(True)
    canvas.draw()
    still, colours = canvas.copy_from_bbox(figure.bbox), None
    for t in range(count):
        canvas.restore_region(still)
        show(t)
        for artist in moving:
            figure.draw_artist(artist)
        picture = Image.fromarray(np.array(canvas.buffer_rgba())).convert("RGB")
        colours = colours or picture.quantize(255)
        yield picture.quantize(palette=colours, dither=Image.Dither.NONE)
