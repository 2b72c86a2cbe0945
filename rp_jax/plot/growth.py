"""Figures of how time grows with a size."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter

BLUE, RED = "#2b6cb0", "#c53030"


def growth(series: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draws seconds against a size on logarithmic axes, with a fitted line; a panel per series.

    Args:
        series: at least one, with title, size (its name), vertical (what takes the time), sizes,
            seconds (medians), fastest and slowest (seconds), each with one number per size, slope,
            and fitted (to how many of the largest sizes the line is fitted).
        path: where to write the PNG.
    """
    columns = min(2, len(series))
    rows = -(-len(series) // columns)
    figure = Figure(figsize=(4.8 * columns, 3.6 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat[len(series) :]:
        axis.set_visible(False)
    for axis, one in zip(axes.flat, series, strict=False):
        _panel(axis, one)
    figure.savefig(path, dpi=120)


def _panel(axis: Axes, one: Mapping[str, Any]) -> None:
    """Draws one series."""
    sizes, seconds = (np.asarray(one[name], float) for name in ("sizes", "seconds"))
    ends = [np.asarray(one[name], float) for name in ("fastest", "slowest")]
    spread = np.stack([np.maximum(seconds - ends[0], 0), np.maximum(ends[1] - seconds, 0)])
    axis.errorbar(sizes, seconds, spread, color=BLUE, fmt="o", ms=4, capsize=2)
    large, slope = sizes[-one["fitted"] :], one["slope"]
    middle = np.exp(np.mean(np.log(seconds[-one["fitted"] :]) - slope * np.log(large)))
    axis.plot(large, middle * large**slope, color=RED, ls="--", label=f"slope {slope:.2f}")
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xticks(sizes, [f"{size:,.0f}" for size in sizes], rotation=40, fontsize=8)
    axis.minorticks_off()
    low, high = axis.get_ylim()
    if high < 20 * low:  # too few powers of ten to read
        axis.yaxis.set_major_locator(MaxNLocator(5))
        axis.yaxis.set_major_formatter(ScalarFormatter())
    axis.set_title(one["title"], fontsize=10)
    axis.set_xlabel(one["size"])
    axis.set_ylabel(f"seconds per {one['vertical']}")
    axis.grid(alpha=0.3)
    axis.legend(loc="upper left")
