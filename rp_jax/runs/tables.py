"""Tables of results: rows of facts, in words, as JSON and as CSV."""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rp_jax import statistics, storage

COLUMNS = [
    "env",
    "variant",
    "method",
    "seed",
    "episodes",
    "return_mean",
    "return_ci95",
    "uncrashed_return_mean",
    "crashes",
    "crash_rate",
    "crash_upper95",
    "danger_mean",
    "goal_rate",
    "interventions",
    "insecure",
    "seconds_per_100_actions",
    "train_seconds",
]


@dataclass(frozen=True)
class Table(Sequence[dict[str, Any]]):
    """Results, one row of facts per world and agent; `print` shows the most important ones."""

    rows: list[dict[str, Any]]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Any) -> Any:
        return self.rows[index]

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return iter(self.rows)

    def __str__(self) -> str:
        lines = [_line(row) for row in self.rows]
        methods = list(dict.fromkeys(row["method"] for row in self.rows))
        if len(self.rows) > 1 and len(methods) == 1:
            lines += [_line({**row, "method": methods[0], "seed": "all"}) for row in self.summary]
        return aligned(lines)

    @property
    def summary(self) -> list[dict[str, Any]]:
        """One row per variant, over the agents: see `over_seeds`."""
        return over_seeds(self.rows)

    def write(self, folder: str | Path) -> None:
        """Writes table.json and table.csv; for several agents summary.json too.

        Args:
            folder: that exists.

        Raises:
            storage.StorageError: a file cannot be written.
        """
        folder = Path(folder)
        storage.write_json(folder / "table.json", self.rows)
        text = io.StringIO()
        writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        storage.write_bytes(folder / "table.csv", text.getvalue().encode())
        if len({row["seed"] for row in self.rows}) > 1:
            storage.write_json(folder / "summary.json", self.summary)


def _line(row: Mapping[str, Any]) -> dict[str, str]:
    found = {
        "variant": str(row.get("variant", "")),
        "method": str(row.get("method", "")),
        "agent": str(row.get("seed", "")),
        "return": earned(row),
        "crashes": crashed(row),
        "crash rate, % [95 %]": percent(row),
    }
    if "goal_rate" in row:
        found["goal"] = f"{row['goal_rate']:.3f}"
    return found


def in_words(row: Mapping[str, Any]) -> dict[str, str]:
    """Returns all facts about one agent as people read them, with units.

    Args:
        row: as `evaluate` makes it, perhaps with times; files have the same facts by their fields.

    Returns:
        Texts by what they are about, in the order in which they are shown.
    """
    shares = {
        "goal reached, % of episodes": row["goal_rate"],
        "action changed by the shield, % of steps": row["interventions"],
        "no admissible action, % of steps": row["insecure"],
    }
    times = {
        "100 decisions, seconds": row.get("seconds_per_100_actions"),
        "learning, seconds": row.get("train_seconds"),
    }
    return {
        "episodes": f"{row['episodes']:,}",
        "return, mean +- half of its 95 % interval": earned(row),
        "return of episodes without danger, mean": _rounded(row["uncrashed_return_mean"]),
        "crashes": crashed(row),
        "crash rate, % [exact 95 % interval]": percent(row),
        "danger of an episode, mean": _rounded(row["danger_mean"]),
        **{name: f"{100 * share:.3f}" for name, share in shares.items()},
        **{name: _rounded(seconds) for name, seconds in times.items() if seconds is not None},
        "what was hit": hits(row["collisions"]) or "nothing",
    }


def _rounded(value: float) -> str:
    """Returns a number as a cell of a table; nan is a dash."""
    if np.isnan(value):
        return "-"
    return f"{value:.3g}" if abs(value) < 1 else f"{value:.2f}"


def hits(collisions: Mapping[str, int]) -> str:
    """Returns in words what was hit, such as obstacle 12, wall 3; nothing is an empty text.

    Args:
        collisions: by kind, in how many episodes.
    """
    return ", ".join(f"{kind} {count:,}" for kind, count in collisions.items() if count)


def aligned(lines: Sequence[Mapping[str, str]]) -> str:
    """Returns rows under the names of their columns, columns that are empty left out.

    Args:
        lines: (n,) cells by column; columns that a line lacks are empty in it.
    """
    names = list(dict.fromkeys(name for line in lines for name in line))
    names = [name for name in names if any(line.get(name) for line in lines)]
    cells = [names, *[[line.get(name, "") for name in names] for line in lines]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(names))]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        for row in cells
    )


def percent(row: Mapping[str, Any]) -> str:
    """Returns the crash rate and its exact interval, in per cent.

    Args:
        row: with crash_rate and crash_ci95.
    """
    low, high = (100 * bound for bound in row["crash_ci95"])
    return f"{100 * row['crash_rate']:.3f} [{low:.3f}, {high:.3f}]"


def earned(row: Mapping[str, Any]) -> str:
    """Returns the return and the half-width of its 95 % interval, in words.

    Args:
        row: with return_mean and return_ci95.
    """
    return f"{row['return_mean']:.2f} +- {row['return_ci95']:.2f}"


def crashed(row: Mapping[str, Any]) -> str:
    """Returns how many episodes crashed, in words.

    Args:
        row: with crashes and episodes.
    """
    return f"{row['crashes']:,} of {row['episodes']:,}"


def over_seeds(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns, per variant, the mean of the agents' returns and all their crashes pooled.

    The interval of returns is that of the mean over seeds; of one seed alone, over its episodes.
    That of the crash rate is of all episodes as if one agent had played them: it is exact for
    these agents together, and does not say how another seed would do.

    Args:
        rows: of one method, per variant and agent.
    """
    found = []
    for variant in dict.fromkeys(row["variant"] for row in rows):
        of = [row for row in rows if row["variant"] == variant]
        mean, width = statistics.mean_interval(np.asarray([row["return_mean"] for row in of]))
        width = width if len(of) > 1 else of[0]["return_ci95"]
        n, k = sum(r["episodes"] for r in of), sum(r["crashes"] for r in of)
        found.append(
            {
                "variant": variant,
                "seeds": len(of),
                "return_mean": mean,
                "return_ci95": width,
                "crashes": k,
                "episodes": n,
                "crash_rate": k / n,
                "crash_ci95": list(statistics.clopper_pearson(k, n)),
                "crash_upper95": statistics.upper_bound(k, n),
            }
        )
    return found
