"""Learning curves."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from rp_jax import statistics

matplotlib.use("Agg")
from matplotlib import pyplot as plt

BLUE, RED, GREY = "#2b6cb0", "#c53030", "#718096"


def learning_curves(history: Sequence[Mapping[str, Any]], title: str, path: Path) -> None:
    """Return, crash rate and states without an admissible action, against agent steps.

    Args:
        history: one row per chunk and seed, as in metrics.jsonl.
        title: of the figure.
        path: of the PNG.
    """
    steps = sorted({row["steps"] for row in history})
    of = {s: [row for row in history if row["steps"] == s] for s in steps}
    figure, axes = plt.subplots(3, 1, figsize=(7, 7.5), sharex=True, layout="constrained")
    seeds = sorted({row["seed"] for row in history})
    for seed in seeds:
        mine = [row for row in history if row["seed"] == seed and row["episodes"]]
        axes[0].plot(
            [r["steps"] for r in mine], [r["return_mean"] for r in mine], color=BLUE, alpha=0.25
        )
    means = [
        (s, np.mean([r["return_mean"] for r in of[s] if r["episodes"]]))
        for s in steps
        if any(r["episodes"] for r in of[s])
    ]
    label = f"mean of {len(seeds)} seed(s)"
    axes[0].plot([s for s, _ in means], [mean for _, mean in means], color=BLUE, label=label)
    axes[0].set_ylabel("return while exploring\n(crash penalty included)")
    axes[0].legend(loc="lower right")
    rates, low, high = [], [], []
    ended = [s for s in steps if sum(r["episodes"] for r in of[s])]
    for s in ended:
        k, n = (sum(r[name] for r in of[s]) for name in ("crashes", "episodes"))
        bounds = statistics.clopper_pearson(k, n)
        rates.append(k / n)
        low.append(bounds[0])
        high.append(bounds[1])
    axes[1].plot(ended, rates, color=RED)
    axes[1].fill_between(ended, low, high, color=RED, alpha=0.2, label="95 % Clopper-Pearson")
    axes[1].set_ylabel("crashes per episode\nwhile exploring")
    axes[1].set_ylim(bottom=0)
    axes[1].legend(loc="upper right")
    axes[2].plot(steps, [np.mean([r["insecure"] for r in of[s]]) for s in steps], color=GREY)
    axes[2].set_ylabel("share of states with no\nadmissible action")
    axes[2].set_ylim(bottom=0)
    axes[2].set_xlabel("agent steps")
    for axis in axes:
        axis.grid(alpha=0.3)
    figure.suptitle(title)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def methods(history: Sequence[Mapping[str, Any]], title: str, path: Path) -> None:
    """Return and crash rate while learning, a line per method; seeds taken together.

    Args:
        history: one row per chunk, method and seed, as in metrics.jsonl.
        title: of the figure.
        path: of the PNG.
    """
    figure, axes = plt.subplots(2, 1, figsize=(7, 5.5), sharex=True, layout="constrained")
    names = dict.fromkeys(row["method"] for row in history)
    for colour, name in zip((GREY, RED, BLUE), names, strict=False):
        of = [row for row in history if row["method"] == name and row["episodes"]]
        steps = sorted({row["steps"] for row in of})
        groups = [[row for row in of if row["steps"] == s] for s in steps]
        returns = [np.mean([row["return_mean"] for row in group]) for group in groups]
        axes[0].plot(steps, returns, color=colour, label=name)
        counts = [[sum(r[k] for r in g) for k in ("crashes", "episodes")] for g in groups]
        axes[1].plot(steps, [100 * k / n for k, n in counts], color=colour)
        bounds = np.asarray([statistics.clopper_pearson(k, n) for k, n in counts])
        axes[1].fill_between(steps, *(100 * bounds).T, color=colour, alpha=0.2, linewidth=0)
    axes[0].set_ylabel("return while exploring\n(crash penalty included)")
    axes[1].set_ylabel("episodes with a crash, %\n(shaded: 95 % Clopper-Pearson)")
    axes[1].set_xlabel("agent steps")
    axes[1].set_ylim(bottom=0)
    axes[0].legend()
    for axis in axes:
        axis.grid(alpha=0.3)
    figure.suptitle(title)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def frontier(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Return and crash rate over the threshold, with 95 % intervals, a column per variant.

    Args:
        rows: with variant, planner, x, return_mean, return_ci95, crash_rate, crash_ci95.
        path: of the PNG.
    """
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    planners = list(dict.fromkeys(row["planner"] for row in rows))
    figure, axes = plt.subplots(
        2,
        len(variants),
        figsize=(3.8 * len(variants), 6),
        sharex=True,
        layout="constrained",
        squeeze=False,
    )
    for j, variant in enumerate(variants):
        for colour, shift, planner in zip((BLUE, RED), (0.97, 1.03), planners, strict=False):
            of = [r for r in rows if r["variant"] == variant and r["planner"] == planner]
            x = [shift * r["x"] for r in of]
            style = {"color": colour, "marker": ".", "capsize": 2, "label": planner}
            returns, widths = ([r[k] for r in of] for k in ("return_mean", "return_ci95"))
            axes[0, j].errorbar(x, returns, widths, **style)
            rates = np.asarray([100 * r["crash_rate"] for r in of])
            low, high = 100 * np.asarray([r["crash_ci95"] for r in of]).T
            axes[1, j].errorbar(x, rates, np.stack([rates - low, high - rates]), **style)
        axes[0, j].set_title(variant)
        axes[1, j].set_xlabel("threshold x")
        for axis in axes[:, j]:
            axis.set_xscale("log")
            axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("return (crash penalty included)")
    axes[1, 0].set_ylabel("episodes with a crash, %")
    axes[0, 0].legend()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def fit_curves(curves: Mapping[str, Sequence[Mapping[str, float]]], path: Path) -> None:
    """Training and validation loss of the threat models, by kind of hazard."""
    figure, axes = plt.subplots(
        1, len(curves), figsize=(4.5 * len(curves), 3.4), layout="constrained", squeeze=False
    )
    for axis, (kind, rows) in zip(axes[0], curves.items(), strict=True):
        steps = [row["step"] for row in rows]
        axis.plot(steps, [row["loss"] for row in rows], color=BLUE, label="training")
        held = [row["validation_loss"] for row in rows]
        axis.plot(steps, held, color=RED, label="validation")
        axis.set_title(f"threat of one {kind}")
        axis.set_xlabel("gradient steps")
        axis.set_ylabel("cross entropy")
        axis.legend()
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def comparison(
    rows: Sequence[Mapping[str, Any]],
    *,
    panels: tuple[str, str],
    line: str,
    horizontal: str,
    vertical: Sequence[str],
    path: Path,
) -> None:
    """Lines of means over repeats, with each repeat as a dot; both axes logarithmic.

    Args:
        rows: one per measurement.
        panels: two fields whose values name a panel's column.
        line: field whose values name the lines.
        horizontal: field of the horizontal axis.
        vertical: fields of the vertical axes, one row of panels each.
        path: of the PNG.
    """
    columns = list(dict.fromkeys(tuple(row[name] for name in panels) for row in rows))
    figure, axes = plt.subplots(
        len(vertical),
        len(columns),
        figsize=(3.6 * len(columns), 3.1 * len(vertical)),
        layout="constrained",
        squeeze=False,
    )
    for i, quantity in enumerate(vertical):
        for j, column in enumerate(columns):
            axis = axes[i, j]
            here = [row for row in rows if tuple(row[name] for name in panels) == column]
            for colour, name in zip(
                (GREY, RED, BLUE), dict.fromkeys(r[line] for r in here), strict=False
            ):
                of = [row for row in here if row[line] == name]
                places = sorted({row[horizontal] for row in of})
                means = [np.mean([r[quantity] for r in of if r[horizontal] == p]) for p in places]
                axis.plot(places, means, color=colour, label=name)
                axis.plot([r[horizontal] for r in of], [r[quantity] for r in of], ".", color=colour)
            axis.set_xscale("log")
            axis.set_yscale("log" if all(r[quantity] > 0 for r in here) else "linear")
            axis.set_xlabel(f"labelled {horizontal}")
            axis.grid(alpha=0.3, which="both")
            if i == 0:
                axis.set_title(", ".join(column), fontsize=10)
            if j == 0:
                axis.set_ylabel(quantity.replace("_", " "))
                axis.legend()
    figure.savefig(path, dpi=120)
    plt.close(figure)
