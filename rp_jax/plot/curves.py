"""Figures of learning curves, scores, thresholds and crashes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from rp_jax import statistics

BLUE, RED, GREY = "#2b6cb0", "#c53030", "#718096"
ENOUGH = 256  # episodes of an agent in a point of a learning curve, at least, or a tenth of all
POOLED = f"a point: at least {ENOUGH} episodes of an agent, or a tenth of all"
WORDS = {  # for names of fields
    "rmse": "root mean square error of the threat",
    "unsafe_called_safe": "share of unsafe pairs called safe",
    "states": "labelled states",
}


def plain(name: str) -> str:
    """Returns a name in plain words, as a title: without underscores, and with a capital.

    Args:
        name: such as jam: RP (x=0.01).
    """
    words = name.replace("_", " ")
    return words[:1].upper() + words[1:]


def pooled(history: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns learning curves with enough episodes in every point: chunks are put together.

    Agents play many episodes side by side, and the short ones end first: a chunk in which few ended
    tells of short episodes only.

    Args:
        history: of one method, one row per chunk and seed, as in metrics.jsonl.

    Returns:
        A row per point and seed with steps, episodes, return_mean and crashes; no row where no
        episode of a seed ended.
    """
    seeds = sorted({row["seed"] for row in history})
    total = sum(row["episodes"] for row in history)
    enough = max(1, min(ENOUGH * len(seeds), total // 10))
    points: list[list[Mapping[str, Any]]] = [[]]
    for steps in sorted({row["steps"] for row in history}):
        if sum(row["episodes"] for row in points[-1]) >= enough:
            points.append([])
        points[-1] += [row for row in history if row["steps"] == steps]
    if len(points) > 1 and sum(row["episodes"] for row in points[-1]) < enough:
        few = points.pop()
        points[-1] += few
    return [_together(point, seed) for point in points for seed in seeds if _ended(point, seed)]


def _ended(point: Sequence[Mapping[str, Any]], seed: int) -> list[Mapping[str, Any]]:
    """Returns a seed's rows of a point in which episodes ended."""
    return [row for row in point if row["seed"] == seed and row["episodes"]]


def _together(point: Sequence[Mapping[str, Any]], seed: int) -> dict[str, Any]:
    """Returns one row for a seed's rows of a point."""
    rows = _ended(point, seed)
    counts = [row["episodes"] for row in rows]
    return {
        "seed": seed,
        "steps": max(row["steps"] for row in point),
        "episodes": sum(counts),
        "return_mean": float(np.average([row["return_mean"] for row in rows], weights=counts)),
        "crashes": sum(row["crashes"] for row in rows),
    }


def learning_curves(history: Sequence[Mapping[str, Any]], title: str, path: Path) -> None:
    """Draws return, crash rate and the share of states without an admissible action, against steps.

    Points of returns and crash rates pool enough episodes (`pooled`).

    Args:
        history: one row per chunk and seed, as in metrics.jsonl.
        title: title of the figure.
        path: where to write the PNG.
    """
    points, seeds = pooled(history), len({row["seed"] for row in history})
    at = sorted({row["steps"] for row in points})
    of = {s: [row for row in points if row["steps"] == s] for s in at}
    figure = Figure(figsize=(7, 7.5), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    for seed in sorted({row["seed"] for row in points}) if seeds > 1 else ():
        mine = [row for row in points if row["seed"] == seed]
        returns = [row["return_mean"] for row in mine]
        axes[0].plot([row["steps"] for row in mine], returns, color=BLUE, alpha=0.25)
    label = f"mean of {seeds} agents" if seeds > 1 else "one agent"
    means = [np.mean([row["return_mean"] for row in of[s]]) for s in at]
    axes[0].plot(at, means, color=BLUE, marker=".", label=label)
    axes[0].set_ylabel("return while exploring\n(crash penalty included)")
    counts = [[sum(row[name] for row in of[s]) for name in ("crashes", "episodes")] for s in at]
    bounds = [statistics.clopper_pearson(k, n) for k, n in counts]
    low, high = 100 * np.asarray(bounds).reshape(-1, 2).T
    axes[1].plot(at, [100 * k / n for k, n in counts], color=RED, marker=".")
    axes[1].fill_between(at, low, high, color=RED, alpha=0.2, label="95 % interval, exact")
    axes[1].set_ylabel("episodes with a crash\nwhile exploring, %")
    chunks = sorted({row["steps"] for row in history})
    shares = [[row["insecure"] for row in history if row["steps"] == s] for s in chunks]
    axes[2].plot(chunks, [100 * np.mean(share) for share in shares], color=GREY)
    axes[2].set_ylabel("states without an\nadmissible action, %")
    axes[2].set_xlabel(f"agent steps ({POOLED})")
    axes[2].xaxis.set_major_formatter(EngFormatter(sep=""))
    for axis, corner in zip(axes, ("lower right", "upper right", None), strict=True):
        axis.grid(alpha=0.3)
        if corner:
            axis.legend(loc=corner)
    for axis in axes[1:]:
        axis.set_ylim(bottom=0)
    figure.suptitle(plain(title))
    figure.savefig(path, dpi=120)


def methods(
    panels: Mapping[str, Sequence[Mapping[str, Any]]],
    path: Path,
    levels: Mapping[str, Sequence[Mapping[str, Any]]] | None = None,
) -> None:
    """Draws return and crash rate while learning, with a column per task and a line per method.

    Points pool enough episodes (`pooled`). Lines are means over seeds, bands 90 % intervals of
    Student. For a single seed the band of the
    crash rate is the 90 % interval of Clopper and Pearson.

    Args:
        panels: by the task's title, one row per chunk, method and seed, as in metrics.jsonl.
        path: where to write the PNG.
        levels: by the task's title, rows with method, return_mean and crash_rate of methods that do
            not learn; drawn dashed.
    """
    most = max(len({row["method"] for row in history}) for history in panels.values())
    below = 0.12 + 0.06 * (most // 2 + 2)  # height of the legend
    figure = Figure(figsize=(max(7, 4.6 * len(panels)), 6.6), layout="constrained")
    axes = figure.subplots(3, len(panels), height_ratios=(1, 1, below), sharex="col", squeeze=False)
    for column, (title, history) in zip(axes.T, panels.items(), strict=True):
        colours = {True: iter(OURS), False: iter(OTHERS)}
        for name in dict.fromkeys(row["method"] for row in history):
            of = pooled([row for row in history if row["method"] == name])
            _line(column, of, next(colours[name.startswith("RP")], "black"), name)
        for row, dashes in zip((levels or {}).get(title, ()), ("--", ":", "-."), strict=False):
            style = {"color": "black", "linestyle": dashes, "linewidth": 1}
            column[0].axhline(row["return_mean"], label=row["method"], **style)
            column[1].axhline(100 * row["crash_rate"], **style)
        column[0].set_title(plain(title))
        _percent(column[1], "y")
        column[1].set_xlabel("agent steps")
        column[1].tick_params(labelbottom=True)
        column[1].xaxis.set_major_locator(MaxNLocator(6))
        column[1].xaxis.set_major_formatter(EngFormatter(sep=""))
        for axis in column[:2]:
            axis.grid(alpha=0.3)
        column[2].axis("off")
        handles, labels = column[0].get_legend_handles_labels()
        column[2].legend(handles, labels, loc="upper center", fontsize=8, ncols=2)
    axes[0, 0].set_ylabel("return while exploring\n(crash penalty included)")
    axes[1, 0].set_ylabel("episodes with a crash\nwhile exploring, %")
    figure.supxlabel(POOLED, fontsize=9)
    figure.savefig(path, dpi=120)


OURS = (BLUE, "#63b3ed")
OTHERS = (RED, "#dd6b20", "#d69e2e", "#2f855a", "#805ad5", "#d53f8c", GREY)


def _percent(axis: Any, which: str) -> None:
    """Sets an axis ("x" or "y") to show crash rates from 0 to 100 % on one scale."""
    getattr(axis, f"set_{which}scale")("symlog", linthresh=0.01)
    getattr(axis, f"set_{which}lim")(-0.001, 130)
    ticks, names = [0, 0.01, 0.1, 1, 10, 100], ["0", ".01", ".1", "1", "10", "100"]
    getattr(axis, f"set_{which}ticks")(ticks, names)


def _line(axes: Any, rows: Sequence[Mapping[str, Any]], colour: str, name: str) -> None:
    """Draws a method's return and crash rate, with their bands."""
    steps = sorted({row["steps"] for row in rows})
    groups = [[row for row in rows if row["steps"] == s] for s in steps]
    returns = [_band([row["return_mean"] for row in group]) for group in groups]
    rates = [_band([100 * row["crashes"] / row["episodes"] for row in group]) for group in groups]
    for i, group in enumerate(groups):
        if len(group) == 1:
            k, n = group[0]["crashes"], group[0]["episodes"]
            low, high = statistics.clopper_pearson(k, n, 0.9)
            rates[i] = (rates[i][0], 100 * low, 100 * high)
    for axis, found in zip(axes, (returns, rates), strict=False):
        means, lows, highs = np.asarray(found).reshape(-1, 3).T
        axis.plot(steps, means, color=colour, label=name)
        axis.fill_between(steps, lows, highs, color=colour, alpha=0.2, linewidth=0)


def _band(values: Sequence[float]) -> tuple[float, float, float]:
    """Returns (mean, low, high) of the 90 % interval; all are equal for a single value."""
    mean, width = statistics.mean_interval(np.asarray(values), 0.9)
    width = 0.0 if np.isnan(width) else width
    return mean, mean - width, mean + width


def scores(
    rows: Sequence[Mapping[str, Any]],
    published: Mapping[str, Mapping[str, tuple[float, float]]],
    path: Path,
) -> None:
    """Draws return and crash rate of each method with 95 % intervals, with panels per variant.

    Args:
        rows: rows with variant, method, return_mean, return_ci95, crash_rate and crash_ci95.
        published: by variant and method, the published (return, crash rate); drawn as diamonds.
        path: where to write the PNG.
    """
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    size = (10, (0.9 + 0.27 * len(methods)) * len(variants))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(variants), 2, sharey=True, squeeze=False)
    for (left, right), variant in zip(axes, variants, strict=True):
        for row in rows:
            if row["variant"] != variant:
                continue
            y, rate = len(methods) - methods.index(row["method"]), 100 * row["crash_rate"]
            low, high = (100 * bound for bound in row["crash_ci95"])
            style = {"fmt": "o", "color": BLUE, "markersize": 4, "capsize": 2}
            left.errorbar(row["return_mean"], y, xerr=row["return_ci95"], **style)
            error = [[max(0.0, rate - low)], [max(0.0, high - rate)]]
            right.errorbar(rate, y, xerr=error, **style)
        for method, (earned, rate) in published.get(variant, {}).items():
            if method in methods:
                below = len(methods) - methods.index(method) - 0.25
                for axis, value in ((left, earned), (right, 100 * rate)):
                    axis.plot(value, below, "D", color=RED, markersize=4, fillstyle="none")
        left.set_yticks(range(len(methods), 0, -1), methods, fontsize=8)
        left.set_ylim(0.3, len(methods) + 0.7)
        left.set_title(variant, loc="left", fontsize=10)
        _percent(right, "x")
        for axis in (left, right):
            axis.grid(alpha=0.3)
    axes[-1, 0].set_xlabel("return (crash penalty included)")
    axes[-1, 1].set_xlabel("episodes with a crash, %")
    if published:
        axes[0, 0].plot([], [], "o", color=BLUE, markersize=4, label="ours, 95 %")
        axes[0, 0].plot([], [], "D", color=RED, markersize=4, fillstyle="none", label="paper")
        axes[0, 0].legend(fontsize=8, loc="lower left", bbox_to_anchor=(0.55, 1.0), ncols=2)
    figure.savefig(path, dpi=120)


def frontier(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draws return and crash rate against the threshold, with 95 % intervals, by variant.

    Args:
        rows: rows with variant, planner, x, return_mean, return_ci95, crash_rate and crash_ci95.
        path: where to write the PNG.
    """
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    planners = list(dict.fromkeys(row["planner"] for row in rows))
    figure = Figure(figsize=(3.8 * len(variants), 6), layout="constrained")
    axes = figure.subplots(2, len(variants), sharex=True, squeeze=False)
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
        axes[1, j].set_xlabel("threshold x (largest admissible threat)")
        for axis in axes[:, j]:
            axis.set_xscale("log")
            axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("return (crash penalty included)")
    axes[1, 0].set_ylabel("episodes with a crash, %")
    axes[0, 0].legend(title="planner")
    figure.savefig(path, dpi=120)


def promises(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draws the danger that was promised against the crash rate that was met, a panel per test.

    Thick bars are exact 95 % intervals of these agents, thin ones those of the method. Left of the
    diagonal the promise is kept.

    Args:
        rows: rows with variant, promised, crash_rate, crash_ci95, method_crash_ci95, return_mean
            and return_ci95.
        path: where to write the PNG.
    """
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    figure = Figure(figsize=(3.4 * len(variants), 6.2), layout="constrained")
    axes = figure.subplots(2, len(variants), sharey="row", squeeze=False)
    floor = 0.1 * min(row["promised"] for row in rows)
    for (upper, lower), variant in zip(axes.T, variants, strict=True):
        of = [row for row in rows if row["variant"] == variant]
        promised = [row["promised"] for row in of]
        ends = [0.6 * min(promised), 1.6 * max(promised)]
        upper.plot(ends, ends, color="black", linestyle="--", linewidth=1, label="promised = met")
        shown = [max(row["crash_rate"], floor) for row in of]
        for name, width in (("method_crash_ci95", 1), ("crash_ci95", 4)):
            for row in of:
                low, high = row.get(name) or row["crash_ci95"]
                kept = high <= row["promised"] or low <= row["promised"]
                style = {"color": BLUE if kept else RED, "linewidth": width, "alpha": 0.7}
                upper.plot([row["promised"]] * 2, [max(low, floor), max(high, floor)], **style)
        upper.plot(promised, shown, "o", color=BLUE, markersize=5, label="crashes of all episodes")
        upper.set_xscale("log")
        upper.set_yscale("log")
        upper.set_title(variant)
        returns, widths = ([row[k] for row in of] for k in ("return_mean", "return_ci95"))
        lower.errorbar(promised, returns, widths, color=BLUE, marker=".", capsize=2)
        lower.set_xscale("log")
        lower.set_xlabel("danger promised for an episode, c")
        for axis in (upper, lower):
            axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel(f"crash rate met (those below {floor:g} at the edge)")
    axes[0, 0].set_ylim(bottom=0.8 * floor)
    axes[1, 0].set_ylabel("return (crash penalty included)")
    axes[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=120)


def before_crashes(crashes: Sequence[Sequence[Mapping[str, Any]]], path: Path) -> None:
    """Draws the threat and the risks in the last steps before each crash.

    Args:
        crashes: for each crash, rows with `before` (steps before the crash), `threat` (least threat
            of any action), `risk` (probability of a crash after the agent's action) and `best_risk`
            (that after the best action).
        path: where to write the PNG.
    """
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    shown = (
        ("threat", GREY, "least threat of any action, as the agent sees it"),
        ("risk", RED, "risk of its action"),
        ("best_risk", BLUE, "risk of the best action"),
    )
    floor = 1e-3  # smaller risks are hardly measured
    steps = sorted({row["before"] for rows in crashes for row in rows})
    for axis, (name, colour, title) in zip(axes, shown, strict=True):
        for rows in crashes:
            heights = np.maximum([row[name] for row in rows], floor)
            axis.plot([-row["before"] for row in rows], heights, color=colour, alpha=0.25)
        middle = [
            np.median([row[name] for rows in crashes for row in rows if row["before"] == step])
            for step in steps
        ]
        axis.plot([-s for s in steps], np.maximum(middle, floor), color="black", label="median")
        axis.set_title(title, fontsize=10)
        axis.set_yscale("log")
        axis.set_xlabel("steps before the crash")
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel(f"probability of a crash (at least {floor:g})")
    axes[0].legend()
    figure.savefig(path, dpi=120)


def fit_curves(curves: Mapping[str, Sequence[Mapping[str, float]]], path: Path) -> None:
    """Draws training and validation loss of the threat models, by kind of hazard.

    Args:
        curves: by kind of hazard, rows with step, loss and validation_loss; tables have none.
        path: where to write the PNG; not written where nothing was fitted.
    """
    curves = {kind: rows for kind, rows in curves.items() if rows}
    if not curves:
        return
    figure = Figure(figsize=(4.5 * len(curves), 3.4), layout="constrained")
    axes = figure.subplots(1, len(curves), squeeze=False)
    for axis, (kind, rows) in zip(axes[0], curves.items(), strict=True):
        steps = [row["step"] for row in rows]
        axis.plot(steps, [row["loss"] for row in rows], color=BLUE, label="training")
        held = [row["validation_loss"] for row in rows]
        axis.plot(steps, held, color=RED, label="validation")
        axis.set_title(f"Threat of one {kind.replace('_', ' ')}")
        axis.set_xlabel("gradient steps")
        axis.set_ylabel("cross entropy")
        axis.legend()
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def comparison(
    rows: Sequence[Mapping[str, Any]],
    *,
    panels: tuple[str, str],
    line: str,
    horizontal: str,
    vertical: Sequence[str],
    path: Path,
) -> None:
    """Draws lines of means over repeats, with each repeat as a dot, on logarithmic axes.

    Args:
        rows: one row per measurement.
        panels: two fields whose values name a panel's column.
        line: field whose values name the lines.
        horizontal: field of the horizontal axis.
        vertical: fields of the vertical axes, with one row of panels each.
        path: where to write the PNG.
    """
    columns = list(dict.fromkeys(tuple(row[name] for name in panels) for row in rows))
    size = (3.6 * len(columns), 3.1 * len(vertical))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(vertical), len(columns), squeeze=False)
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
            axis.set_xlabel(WORDS.get(horizontal, horizontal.replace("_", " ")))
            axis.grid(alpha=0.3, which="both")
            if i == 0:
                axis.set_title(plain(", ".join(column)), fontsize=10)
            if j == 0:
                axis.set_ylabel(WORDS.get(quantity, quantity.replace("_", " ")))
                axis.legend()
    figure.savefig(path, dpi=120)
