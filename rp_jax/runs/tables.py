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
    "threat",
    "danger_mean",
    "goal_rate",
    "interventions",
    "insecure",
    "promised",
    "booked_mean",
    "booked_ci95",
    "seconds_per_100_actions",
    "train_seconds",
]
RATE = "crash rate, % [95 %, these agents]"
METHOD_RATE = "[95 %, other seeds]"


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
        **rates(row),
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
        **_account(row),
        "what was hit": hits(row["collisions"]) or "nothing",
    }


def _account(row: Mapping[str, Any]) -> dict[str, str]:
    """Returns what is known of a row's budget, in words; nothing where there is none."""
    if "promised" not in row:
        return {}
    return {
        "danger promised, at most": f"{row['promised']:g}",
        "danger booked, mean +- half of its 95 % interval": (
            f"{row['booked_mean']:.5f} +- {row['booked_ci95']:.5f}"
        ),
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


def rates(row: Mapping[str, Any]) -> dict[str, str]:
    """Returns the crash rate with its two intervals, in per cent, by the names of their columns.

    Args:
        row: with crash_rate and crash_ci95, perhaps with method_crash_ci95.
    """
    own = {RATE: percent(row)}
    return own | {METHOD_RATE: method_percent(row)} if "method_crash_ci95" in row else own


def method_interval(row: Mapping[str, Any]) -> tuple[float, float]:
    """Returns the interval of the method's crash rate; that of the agent where there is but one.

    Args:
        row: with crash_ci95, perhaps with method_crash_ci95.
    """
    low, high = row.get("method_crash_ci95") or row["crash_ci95"]
    return float(low), float(high)


def method_percent(row: Mapping[str, Any]) -> str:
    """Returns the interval of the method's crash rate in per cent; empty for one agent.

    Args:
        row: perhaps with method_crash_ci95, from `over_seeds`.
    """
    if not row.get("method_crash_ci95"):
        return ""
    low, high = (100 * bound for bound in row["method_crash_ci95"])
    return f"[{low:.3f}, {high:.3f}]"


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
    """Returns, per variant, the mean return and the crash rate of all agents, with two intervals.

    `crash_ci95` and `crash_upper95` pool all episodes as if one agent had played them: exact for
    these agents together, and silent on how another seed would do. `method_crash_ci95` and
    `method_crash_upper95` speak of the method: of agents from other seeds, and from other threat
    functions if the rows have several (`statistics.cluster_interval`; None for one agent). The
    interval of returns is over the same clusters; of one agent alone, over its episodes.

    Args:
        rows: of one method, per variant and agent.
    """
    found = []
    for variant in dict.fromkeys(row["variant"] for row in rows):
        of = [row for row in rows if row["variant"] == variant]
        threats = clusters_of(of)
        clusters = threats if len(threats) > 1 else [[row] for row in of]
        returns = [float(np.mean([r["return_mean"] for r in cluster])) for cluster in clusters]
        mean, width = statistics.mean_interval(np.asarray(returns))
        width = width if len(of) > 1 else of[0]["return_ci95"]
        crashes = [sum(r["crashes"] for r in cluster) for cluster in clusters]
        episodes = [sum(r["episodes"] for r in cluster) for cluster in clusters]
        n, k, several = sum(episodes), sum(crashes), len(of) > 1
        interval = list(statistics.cluster_interval(crashes, episodes)) if several else None
        bound = statistics.cluster_upper_bound(crashes, episodes) if several else None
        found.append(
            {
                "variant": variant,
                "seeds": len(of) // max(1, len(threats)),
                "threats": len(threats),
                "return_mean": mean,
                "return_ci95": width,
                "crashes": k,
                "episodes": n,
                "crash_rate": k / n,
                "crash_ci95": list(statistics.clopper_pearson(k, n)),
                "crash_upper95": statistics.upper_bound(k, n),
                "method_crash_ci95": interval,
                "method_crash_upper95": bound,
            }
        )
    return found


def clusters_of(rows: Sequence[Mapping[str, Any]]) -> list[list[Mapping[str, Any]]]:
    """Returns rows by the threat function of their agents; those without one are one cluster.

    Args:
        rows: perhaps with `threat`, the beginning of the checksum of the threat function.
    """
    found: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        found.setdefault(row.get("threat", ""), []).append(row)
    return list(found.values())


def split_chance(rows: Sequence[Mapping[str, Any]]) -> dict[str, statistics.Split]:
    """Splits the variance between agents into that of threat functions and that of the planner.

    The planner's part holds the chance of the episodes too. Crash rates are compared as logits of
    (crashes + .5) / (episodes + 1).

    Args:
        rows: of one method and variant, as many agents for each of several threat functions.

    Returns:
        Of "return" and "logit of the crash rate".

    Raises:
        ValueError: there are fewer than two threat functions, or two agents of each.
    """
    rates = lambda row: (row["crashes"] + 0.5) / (row["episodes"] + 1)  # noqa: E731
    clusters = clusters_of(rows)
    logits = [[float(np.log(rates(r) / (1 - rates(r)))) for r in of] for of in clusters]
    return {
        "return": statistics.variance_split([[r["return_mean"] for r in of] for of in clusters]),
        "logit of the crash rate": statistics.variance_split(logits),
    }
