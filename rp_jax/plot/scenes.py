"""Trajectories of vehicles, and animations of episodes with the threat of every action."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle, Wedge
from matplotlib.patheffects import withStroke
from PIL import Image

from rp_jax.plot.legend import explain

AGENT, OBSTACLE, ZONE = "#d69e2e", "#63b3ed", "#c6f6d5"
NONE_BELOW = "no action is admissible: the least is taken"
GOOD, BAD = "#38a169", "#c53030"
START: dict[str, Any] = {
    "marker": r"$\mathrm{S}$",
    "color": "black",
    "linestyle": "none",
    "markersize": 6,
}
CRASH: dict[str, Any] = {
    "marker": "x",
    "color": BAD,
    "linestyle": "none",
    "markersize": 9,
    "markeredgewidth": 2,
}


class Scene(NamedTuple):
    """Everything that stands still, drawn below the rest."""

    walls: np.ndarray  # (w, 2) wall points, room units
    corners: Sequence[tuple[float, float]] = ()  # corners of the room with safety zones
    zone: float = 0.0  # side of the zones' squares, or their radius, room units
    round_zones: bool = False  # zones are quarter circles
    radius: float = 0.1  # radius of the vehicles, room units
    colours: Sequence[str] = ()  # colour of each obstacle, where they differ
    rings: Sequence[tuple[np.ndarray, float, str]] = ()  # (centres (n, 2), radius, colour)
    names: Mapping[str, str] = {OBSTACLE: "obstacle"}  # of obstacles and rings, by their colour
    exit: np.ndarray | None = None  # (2, 2) ends of the gap in the walls to leave through
    goal: Sequence[float] | None = None  # (2,) the point that progress is measured to
    way: np.ndarray | None = None  # (n, 2, 2) places, and unit vectors of the way to drive there


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
    """Draws walls as dots, safety zones shaded, rings, the exit, the goal and the way to drive.

    Args:
        axis: the matplotlib axes to draw on.
        scene: everything that stands still.
    """
    low, high = scene.walls.min(axis=0), scene.walls.max(axis=0)
    zone: dict[str, Any] = {"color": ZONE, "zorder": 0, "label": "safety zone"}
    for corner in scene.corners:
        if scene.round_zones:
            inner = np.where(np.asarray(corner) == low, 0, 90)
            start = {(0, 0): 0, (90, 0): 90, (90, 90): 180, (0, 90): 270}[tuple(inner)]
            axis.add_patch(Wedge(corner, scene.zone, start, start + 90, **zone))
        else:
            place = np.minimum(corner, high - scene.zone)
            axis.add_patch(Rectangle(place, scene.zone, scene.zone, **zone))
    walls = {"marker": ".", "linestyle": "none", "markersize": 1.5}
    axis.plot(*scene.walls.T, **walls, color="#2d3748", zorder=1, label="wall")
    middles = {"marker": "o", "linestyle": "none", "markersize": 3, "zorder": 1}
    for places, radius, colour in scene.rings:
        for place in places:
            axis.add_patch(Circle(tuple(place), radius, fill=False, edgecolor=colour, zorder=1))
        axis.plot(*np.transpose(places), **middles, color=colour, label=scene.names.get(colour))
    if scene.exit is not None:
        axis.plot(*np.transpose(scene.exit), "--", color=GOOD, linewidth=2, label="exit")
    if scene.goal is not None:
        axis.plot(*scene.goal, "*", color=GOOD, markersize=11, zorder=1, label="goal")
    if scene.way is not None:
        arrows = {"color": "#718096", "zorder": 1, "units": "inches", "width": 0.025, "scale": 5}
        axis.quiver(*scene.way[:, 0].T, *scene.way[:, 1].T, **arrows, scale_units="inches")
        tip = {"marker": r"$\rightarrow$", "linestyle": "none", "markersize": 12}
        axis.plot([], [], **tip, color="#718096", label="way to drive")
    axis.set_aspect("equal")
    axis.set(xlabel="x, room units", ylabel="y, room units")


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
    figure = Figure(figsize=(width, width * shape), layout="constrained")
    axis = figure.subplots()
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


def trajectories(
    panels: Sequence[tuple[str, Scene, Sequence[Episode | Path2D]]], path: Path
) -> None:
    """Draws the paths of several episodes per panel, with a legend below (figure 6).

    An S marks each start, a red cross each crash.

    Args:
        panels: (title, scene, episodes) of each panel.
        path: where to write the PNG.
    """
    columns = min(3, len(panels))
    lines = -(-len(panels) // columns)
    extents = [np.ptp(scene.walls, axis=0) for _, scene, _ in panels]
    shapes = [float(height / width) for width, height in extents]  # of the panels
    heights = [5 * max(shapes[i * columns : (i + 1) * columns]) + 0.6 for i in range(lines)]
    figure = Figure(figsize=(5 * columns, sum(heights) + 0.5), layout="constrained")
    axes = figure.subplots(lines, columns, height_ratios=heights, squeeze=False)
    for axis in axes.flat[len(panels) :]:
        axis.axis("off")
    for axis, (title, scene, episodes) in zip(axes.flat, panels, strict=False):
        draw_scene(axis, scene)
        for episode in episodes:
            dots = "." if len(episode.position) <= 20 else None  # short episodes have long steps
            line = {"marker": dots, "color": "#2b6cb0", "alpha": 0.6, "linewidth": 1}
            axis.plot(*episode.position.T, **line, label="path of the agent")
            axis.plot(*episode.position[0], **START, label="start")
            if episode.hit.any():
                axis.plot(*episode.position[episode.hit].T, **CRASH, zorder=5, label="crash")
        axis.set_title(f"{title}: {_crashed(episodes)}", fontsize=10)
    explain(figure, 8)
    figure.savefig(path, dpi=120, bbox_inches="tight")


def _crashed(episodes: Sequence[Episode | Path2D]) -> str:
    """Returns in words how many episodes crashed."""
    crashes = sum(bool(episode.hit.any()) for episode in episodes)
    if len(episodes) == 1:
        return "a crash" if crashes else "no crash"
    return f"{crashes} of {len(episodes)} episodes crashed"


def animate(
    scene: Scene,
    episode: Episode,
    accelerations: Sequence[float],
    turns: Sequence[float],
    x: float,
    path: Path,
    on_progress: Callable[[int, int], None] | None = None,
    rows: str = "acceleration, room units / step$^2$",
) -> None:
    """Writes an animated GIF: the world on the left, the threat of each action on the right.

    Inadmissible actions are crossed out, and the chosen one is framed; a legend is below.

    Args:
        scene: everything that stands still.
        episode: everything that moves.
        accelerations: accelerations of the action table, one row each, the least one first; it is
            drawn at the bottom.
        turns: turns of the action table, one column each, from right to left.
        x: the threshold.
        path: where to write the GIF.
        on_progress: called with (frames done, frames).
        rows: name and unit of the quantity in the rows.
    """
    frames = len(episode.action)
    figure = Figure(figsize=(9, 5.2), layout="constrained")
    world, table = figure.subplots(1, 2, width_ratios=(1.25, 1))
    in_world, show_world = _world(world, scene, episode)
    in_table, show_table = _table(table, episode, (accelerations, turns), x)
    table.set_ylabel(rows)
    explain(figure, 4)

    def show(t: int) -> None:
        show_world(t)
        show_table(t)

    pictures = []
    for t, picture in enumerate(_pictures(figure, [*in_world, *in_table], show, frames)):
        pictures.append(picture)
        if on_progress:
            on_progress(t + 1, frames)
    pause = 83 if frames > 20 else 333  # milliseconds for a frame
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=pause, loop=0)


Show = Callable[[int], None]  # moves artists to where they are in a given frame


def _world(axis: Any, scene: Scene, episode: Episode) -> tuple[list[Artist], Show]:
    """Draws the world of an animation; returns the artists that move, and what moves them."""
    draw_scene(axis, scene)
    axis.plot(*episode.position[0], **START, label="start")
    (trail,) = axis.plot([], [], color=AGENT, linewidth=1)
    axis.plot([], [], "o", color=AGENT, markersize=9, label="agent, and its path")
    colours = list(scene.colours or [OBSTACLE] * episode.obstacles.shape[1])
    others = [axis.add_patch(Circle((0, 0), scene.radius, color=colour)) for colour in colours]
    for colour in dict.fromkeys(colours):
        axis.plot([], [], "o", color=colour, markersize=9, label=scene.names.get(colour))
    body = axis.add_patch(Circle((0, 0), scene.radius, color=AGENT, zorder=4))
    noses = [
        axis.plot([], [], color="black", linewidth=1, zorder=5)[0] for _ in range(1 + len(others))
    ]
    (crashes,) = axis.plot([], [], **CRASH, zorder=6, label="crash" if episode.hit.any() else None)
    clock = axis.set_title("step 0")

    def show(t: int) -> None:
        trail.set_data(*episode.position[: t + 1].T)
        crashes.set_data(*episode.position[: t + 1][episode.hit[: t + 1]].T)
        body.center = episode.position[t]
        bodies = [(episode.position[t], episode.heading[t])]
        for k, patch in enumerate(others):
            patch.center = episode.obstacles[t, k]
            bodies.append((episode.obstacles[t, k], episode.obstacle_headings[t, k]))
        for nose, (where, way) in zip(noses, bodies, strict=True):
            tip = where + way * scene.radius * 1.4
            nose.set_data([where[0], tip[0]], [where[1], tip[1]])
        clock.set_text(f"step {t}" + (", CRASH" if episode.hit[t] else ""))

    return [trail, *others, body, *noses, crashes, clock], show


def _table(
    axis: Any, episode: Episode, controls: tuple[Sequence[float], Sequence[float]], x: float
) -> tuple[list[Artist], Show]:
    """Draws the threats of an animation's actions; returns as `_world` does."""
    rows, turns = controls
    shape = (len(rows), len(turns))
    # The greatest acceleration is at the top and the strongest turn to the left in the leftmost
    # column, as the driver sees it.
    norm = LogNorm(1e-4, 1, clip=True)
    image = axis.imshow(np.ones(shape), norm=norm, cmap="inferno", origin="lower")
    axis.set_xticks(range(shape[1]), [f"{t:+.2f}" for t in turns[::-1]])
    axis.tick_params(axis="x", labelrotation=0 if shape[1] <= 5 else 60)
    axis.set_yticks(range(shape[0]), [f"{a:+.2f}" for a in rows])
    axis.set_xlabel("turn, radians / step (left is positive)")
    axis.figure.colorbar(image, ax=axis, label="threat of the action", shrink=0.7)
    frame = Rectangle((0, 0), 1, 1, fill=False, edgecolor="cyan", linewidth=3)
    axis.add_patch(frame).set_label("chosen action")
    outline = [withStroke(linewidth=3, foreground="black")]  # to be seen on any colour
    cross: dict[str, Any] = {
        "color": "white",
        "linestyle": "none",
        "markersize": 6,
        "path_effects": outline,
    }
    (crosses,) = axis.plot([], [], marker="x", **cross, label=f"inadmissible: threat above {x:g}")
    told = axis.set_title(NONE_BELOW, fontsize=10)  # so that the layout leaves room for it

    def show(t: int) -> None:
        image.set_data(np.maximum(episode.threat[t].reshape(shape)[:, ::-1], 1e-4))
        upwards, across = np.nonzero(~episode.admissible[t].reshape(shape)[:, ::-1])
        crosses.set_data(across, upwards)
        row, column = divmod(int(episode.action[t]), shape[1])
        frame.set_xy((shape[1] - 1 - column - 0.5, row - 0.5))
        told.set_text("" if episode.secure[t] else NONE_BELOW)

    return [image, frame, crosses, told], show


def _pictures(
    figure: Figure, moving: Sequence[Artist], show: Show, count: int
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
    for _ in range(2):  # the first layout does not know yet how high the legend is
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
