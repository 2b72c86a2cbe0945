"""Why does an agent crash? Each crash of many episodes, step by step, looked at closely.

In the last states before a crash, and for each action, many episodes go on from the same state: by
that action, and then as the agent does. So the risk of what it chose is seen beside that of the
best it could have chosen, and beside the threat that it chose by. The rest was bad luck.

rp-jax crashes --run docs/results/jam_ahead --variant N=8 --out results/crashes
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro

from rp_jax import storage
from rp_jax.cli import errors, terminal
from rp_jax.cli.choice import AgentChoice, Chosen, chosen
from rp_jax.runs.crashes import CrashConfig, look_at_crashes
from rp_jax.runs.train import can_draw


@dataclass(frozen=True, kw_only=True)
class CrashesOptions(AgentChoice):
    """Options of `rp-jax crashes`."""

    out: Path  # new folder for the results
    sizes: Annotated[CrashConfig, tyro.conf.arg(name="")] = field(default_factory=CrashConfig)
    figures: bool = field(default_factory=can_draw)  # draw a figure, with matplotlib

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        super().validate()
        self.sizes.validate()


def run(config: CrashesOptions, found: Chosen, folder: Path) -> dict[str, Any]:
    """Looks at crashes; writes crashes.json, kept up to date, and the figure.

    Args:
        config: the options.
        found: the agents.
        folder: for the results.
    """
    about = {**found.about, "agent": config.agent, "seed": config.seed}

    def keep(result: dict[str, Any]) -> None:
        storage.write_json(folder / "crashes.json", {**about, **result})

    with terminal.progress() as bar:
        result = look_at_crashes(
            jax.random.key(config.seed),
            found.agent(config.agent),
            config.sizes,
            on_result=keep,
            on_progress=bar,
        )
    keep(result)
    if config.figures and result["looked_at"]:
        from rp_jax.plot import curves

        curves.before_crashes([c["steps"] for c in result["looked_at"]], folder / "crashes.png")
    return {**about, **result}


def show(result: dict[str, Any]) -> None:
    """Prints a line per crash.

    Args:
        result: of `run`.
    """
    low, high = (100 * bound for bound in result["crash_ci95"])
    terminal.say(
        f"{result['crashes']} crashes of {result['episodes']:,} episodes, [{low:.3f}, {high:.3f}] %"
    )
    lines = [
        {
            "hit": ", ".join(crash["hit"]),
            "after": f"{crash['length']} steps",
            "none admissible": f"{crash['insecure']} steps",
            "risk before": "-" if crash["entered"] is None else f"{crash['entered']:.3f}",
            "best would have saved": f"{crash['missed']:.2f}, {crash['missed_before']} ahead",
        }
        for crash in result["looked_at"]
    ]
    if lines:
        terminal.table(f"{result['env']} {result['variant']}", lines, list(lines[0]))


def main(argv: Sequence[str]) -> None:
    """Runs the command; exits with 2 on bad input.

    Args:
        argv: arguments after "crashes".
    """
    config = tyro.cli(CrashesOptions, args=list(argv), prog="rp-jax crashes", description=__doc__)
    with errors.bad_input():
        config.validate()
        found = chosen(config)
        errors.needs_matplotlib(config.figures)
        errors.without_figures(config.figures)
        folder = storage.new_folder(config.out)
        storage.write_json(folder / "config.json", dataclasses.asdict(config))
        show(run(config, found, folder))
