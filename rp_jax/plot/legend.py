"""Legend below a figure, outside of its panels."""

from typing import Any

from matplotlib.figure import Figure


def explain(figure: Figure, columns: int = 4) -> None:
    """Adds a legend below all panels, with each label of theirs once; none without labels.

    Args:
        figure: with a constrained layout, and all that it shows.
        columns: at most so many labels side by side.
    """
    found: dict[str, Any] = {}
    for axis in figure.axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    if found:
        figure.legend(
            list(found.values()),
            list(found),
            loc="outside lower center",
            ncols=min(columns, len(found)),
            fontsize=9,
        )
