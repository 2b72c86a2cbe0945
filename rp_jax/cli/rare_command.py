"""Estimates how rarely an agent crashes, and finds the starts it crashes from most.

Multilevel splitting against plain episodes of as many steps; then a search for the worst starts.

rp-jax rare --run results/RUN --variant N=8 --out results/rare

Another agent, from the worst starts of that one:

rp-jax rare --run results/NEW --variant N=8 --out results/again --starts results/rare/worst_starts
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro

from rp_jax import statistics, storage
from rp_jax.cli import errors, terminal
from rp_jax.cli.choice import AgentChoice, Chosen, chosen
from rp_jax.runs import rare_events
from rp_jax.runs.rare_events import RareConfig
from rp_jax.streams import Stream, key_of


@dataclass(frozen=True, kw_only=True)
class RareOptions(AgentChoice):
    """Options of `rp-jax rare`."""

    out: Path  # new folder for the results
    sizes: Annotated[RareConfig, tyro.conf.arg(name="")] = field(default_factory=RareConfig)
    starts: Path | None = None  # worst starts found before: these alone are played

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        super().validate()
        self.sizes.validate()


def known(config: RareOptions, found: Chosen) -> Any:
    """Returns the starts that were found before; None if there are none.

    Args:
        config: the options.
        found: the agents.

    Raises:
        ValueError: there is no such set of starts.
    """
    if config.starts is None:
        return None
    return rare_events.load_starts(config.starts, found.agents.pmdp, found.about)


def run(config: RareOptions, found: Chosen, folder: Path) -> dict[str, Any]:
    """Measures an agent; writes rare.json and, after a search, the folder worst_starts.

    Args:
        config: the options.
        found: the agents.
        folder: for the results.
    """
    starts, sizes = known(config, found), config.sizes
    row: dict[str, Any] = {**found.about, "agent": config.agent, "seed": config.seed}
    subject = rare_events.subject_of(found.agent(config.agent))
    own = key_of(jax.random.key(config.seed), Stream.RARE)
    key, search, check = jax.random.split(own, 3)
    with terminal.progress() as bar:
        if starts is None:
            estimate, first = rare_events.estimate(key, subject, sizes, bar)
            row |= estimate
            storage.write_json(folder / "rare.json", row)  # the search may take long
            if sizes.generations > 0:
                starts = rare_events.worst_starts(search, subject, first, sizes, bar)
                rare_events.save_starts(folder / "worst_starts", starts, found.about)
        if starts is not None:
            row["worst_starts"] = rare_events.checked_starts(check, subject, starts, sizes.checks)
    storage.write_json(folder / "rare.json", row)
    return row


def show(row: dict[str, Any]) -> None:
    """Prints the estimates, and the starts that were found.

    Args:
        row: of `run`.
    """
    if "plain" in row:
        plain = row["plain"]
        lines = [
            {
                "by": f"splitting, {len(row['levels'])} levels, {row['repeats']} repeats",
                "crash rate": f"{row['estimate']:.3g}",
                "95 %": "[{:.3g}, {:.3g}]".format(*row["ci95"]) if row["ci95"] else "-",
                "steps": f"{row['steps']:,}",
            },
            {
                "by": f"plain, {plain['crashes']} of {plain['episodes']:,} episodes",
                "crash rate": f"{plain['rate']:.3g}",
                "95 %": "[{:.3g}, {:.3g}]".format(*plain["ci95"]),
                "steps": f"{plain['steps']:,}",
            },
        ]
        terminal.table(f"crash rate of {row['env']} {row['variant']}", lines, list(lines[0]))
    if rows := row.get("worst_starts"):
        k, n = sum(r["crashes"] for r in rows), sum(r["episodes"] for r in rows)
        low, high = statistics.clopper_pearson(k, n)
        terminal.say(
            f"from the {len(rows)} worst starts found: {k} crashes of {n:,}, "
            f"{100 * k / n:.2f} [{100 * low:.2f}, {100 * high:.2f}] %"
        )


def main(argv: Sequence[str]) -> None:
    """Runs the command; exits with 2 on bad input.

    Args:
        argv: arguments after "rare".
    """
    config = tyro.cli(RareOptions, args=list(argv), prog="rp-jax rare", description=__doc__)
    with errors.bad_input():
        config.validate()
        found = chosen(config)
        known(config, found)
        folder = storage.new_folder(config.out)
        storage.write_json(folder / "config.json", dataclasses.asdict(config))
        show(run(config, found, folder))
