"""Figures of finite CMDPs (figures 2 and 3)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

FLOOR = 1e-6  # smaller threats have the same colour
COLOURS = ("#c05621", "#805ad5", "#2c7a7b", "#2b6cb0", "#1a202c")
MARKERS = ("o", "^", "v", "s", "D")


def lake(
    rows: Sequence[str], threat: np.ndarray, actions: Sequence[str], title: str, path: Path
) -> None:
    """Draws the threat of each action on the map, with holes in grey.

    Args:
        rows: rows of the map, as for `frozen_lake`.
        threat: (A, rows, columns) threats.
        actions: names of the actions.
        title: title of the figure.
        path: where to write the PNG.
    """
    letters = np.asarray([[*row] for row in rows])
    figure = Figure(figsize=(3.3 * len(actions), 3.9), layout="constrained")
    axes = figure.subplots(1, len(actions), squeeze=False)
    colours = colormaps["inferno"].with_extremes(bad="#4a5568")
    norm = LogNorm(FLOOR, 1.0, clip=True)
    for axis, name, values in zip(axes[0], actions, threat, strict=True):
        shown = np.ma.array(np.maximum(values, FLOOR), mask=letters == "H")
        axis.imshow(shown, norm=norm, cmap=colours)
        for (row, column), letter in np.ndenumerate(letters):
            if letter in "SG":
                axis.text(column, row, letter, color="white", ha="center", va="center")
            elif letter == "H":
                axis.text(column, row, "hole", color="white", ha="center", va="center", size=6)
            elif values[row, column] <= 0:
                axis.text(column, row, "0", color="#a0aec0", ha="center", va="center", size=7)
        axis.set_title(name)
        axis.set_xlabel("column")
        axis.set_xticks(range(letters.shape[1]), range(1, letters.shape[1] + 1), size=7)
        axis.set_yticks(range(letters.shape[0]), range(1, letters.shape[0] + 1), size=7)
    figure.colorbar(
        ScalarMappable(norm, colours),
        ax=axes,
        label="threat of the action (0 where marked)",
        shrink=0.75,
    )
    axes[0, 0].set_ylabel("row")
    figure.suptitle(title)
    figure.savefig(path, dpi=110)


def budgets(
    rows: Sequence[Mapping[str, Any]],
    optima: Sequence[Mapping[str, Any]],
    baselines: Sequence[str],
    path: Path,
    rule: str = "paper",
) -> None:
    """Draws return and danger against the bound c, with one column per lake (figures 3a and 3b).

    Args:
        rows: rows with variant, baseline, rule, c, return_mean and danger (None where no baseline
            policy is safe).
        optima: rows with variant, c, optimum, lagrangian and lagrangian_danger.
        baselines: names of the baseline policies, one line each.
        path: where to write the PNG.
        rule: the threshold rule whose rows are drawn.
    """
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    figure = Figure(figsize=(4.2 * len(variants), 7), layout="constrained")
    axes = figure.subplots(2, len(variants), squeeze=False)
    for column, variant in enumerate(variants):
        above, below = axes[:, column]
        best = [row for row in optima if row["variant"] == variant]
        c = [row["c"] for row in best]
        above.plot(c, [row["optimum"] for row in best], "k-", label="exact optimum")
        one = {"color": "#718096", "linestyle": "--", "label": "one Lagrange multiplier"}
        above.plot(c, [_number(row["lagrangian"]) for row in best], **one)
        below.plot(c, c, "k:", label="the bound c")
        below.plot(c, [_number(row["lagrangian_danger"]) for row in best], **one)
        for i, baseline in enumerate(baselines):
            mine = _of(rows, variant, baseline, rule)
            style = _style(i, baseline)
            above.plot(c, [_number(row["return_mean"]) for row in mine], **style)
            below.plot(c, [_number(row["danger"]) for row in mine], **style)
        above.set_title(variant)
        for axis in (above, below):
            axis.set_xscale("log")
        below.set_yscale("symlog", linthresh=1e-5)
        below.set_ylim(0, None)
        below.set_xlabel("bound c on the danger of an episode")
    axes[0, 0].set_ylabel("return (chance of the goal)")
    axes[1, 0].set_ylabel("danger of an episode")
    for axis in axes[:, 0]:
        axis.legend(fontsize=8)
    figure.suptitle(
        f"Threshold rule: {rule}. eta: baseline policies; no mark: it is not safe at this c"
    )
    figure.savefig(path, dpi=110)


def shares(
    rows: Sequence[Mapping[str, Any]], rules: Sequence[str], path: Path, baseline: str = "eta*"
) -> None:
    """Draws the return of each threshold rule as a share of the exact optimum, against c.

    Args:
        rows: rows with variant, baseline, rule, c and share.
        rules: names of the threshold rules, one line each.
        path: where to write the PNG.
        baseline: the baseline policy whose rows are drawn.
    """
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    figure = Figure(figsize=(4 * len(variants), 3.8), layout="constrained")
    axes = figure.subplots(1, len(variants), sharey=True, squeeze=False)[0]
    for axis, variant in zip(axes, variants, strict=True):
        for i, rule in enumerate(rules):
            mine = _of(rows, variant, baseline, rule)
            earned = [_number(row["share"]) for row in mine]
            axis.plot([row["c"] for row in mine], earned, **_style(i, rule))
        axis.set_xscale("log")
        axis.set_title(variant)
        axis.set_xlabel("bound c on the danger of an episode")
    axes[0].set_ylabel("share of the exact optimum")
    axes[-1].legend(fontsize=8, title="threshold rule")
    figure.savefig(path, dpi=110)


def _of(
    rows: Sequence[Mapping[str, Any]], variant: str, baseline: str, rule: str
) -> list[Mapping[str, Any]]:
    """Returns the rows of one line."""
    wanted = (variant, baseline, rule)
    return [row for row in rows if (row["variant"], row["baseline"], row["rule"]) == wanted]


def _style(i: int, label: str) -> dict[str, Any]:
    """Returns how the i-th line is drawn."""
    look = {"color": COLOURS[i], "marker": MARKERS[i], "markersize": 5, "alpha": 0.8}
    return {**look, "label": label}


def _number(value: float | None) -> float:
    """Returns a number, nan for None."""
    return float("nan") if value is None else value
