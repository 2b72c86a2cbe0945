"""Heat maps of threats (figure 4b to 4d)."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from rp_jax.plot.legend import explain

FLOOR = 1e-4  # smaller threats have the same colour


class Panel(NamedTuple):
    """The data of one heat map."""

    title: str
    threat: np.ndarray  # (ny, nx) from the bottom left
    extent: tuple[float, float, float, float]  # left, right, bottom, top, room units
    horizontal: str = "x, room units"  # what the axes show
    vertical: str = "y, room units"


def heat_maps(panels: Sequence[Panel], x: float, path: Path, decorate=None) -> None:
    """Draws threats in colour on a logarithmic scale, with a line where they equal x.

    Args:
        panels: drawn side by side.
        x: the threshold.
        path: where to write the PNG.
        decorate: called with (axis, index) to add to a panel; what has a label is explained below.
    """
    columns = min(3, len(panels))
    lines = -(-len(panels) // columns)
    figure = Figure(figsize=(4.6 * columns, 4.2 * lines + 0.3), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False)
    for i, axis in enumerate(axes.flat):
        if i >= len(panels):
            axis.axis("off")
            continue
        panel = panels[i]
        axis.imshow(
            np.maximum(panel.threat, FLOOR),
            origin="lower",
            extent=panel.extent,
            norm=LogNorm(FLOOR, 1.0, clip=True),
            cmap="inferno",
        )
        if x > 0 and panel.threat.min() < x < panel.threat.max():
            axis.contour(
                panel.threat, [x], extent=panel.extent, origin="lower", colors="cyan", linewidths=1
            )
            axis.add_line(
                Line2D(
                    [], [], color="cyan", linewidth=1, label=f"threat equal to the threshold, {x:g}"
                )
            )
        axis.set(xlabel=panel.horizontal, ylabel=panel.vertical)
        axis.set_title(panel.title, fontsize=10)
        axis.set_aspect("equal")
        if decorate is not None:
            decorate(axis, i)
    scale = ScalarMappable(LogNorm(FLOOR, 1.0, clip=True), "inferno")
    figure.colorbar(scale, ax=axes, label="threat of the least threatening action", shrink=0.8)
    explain(figure)
    figure.savefig(path, dpi=120, bbox_inches="tight")
