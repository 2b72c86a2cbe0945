"""Shows, or fails to show, that an agent's crash rate is at most c.

How many episodes it takes, and how many crashes are allowed, is settled before any is played.

rp-jax certify --run results/RUN --c 1e-3 --confidence .99
"""

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import tyro

import rp_jax
from rp_jax import storage
from rp_jax.cli import errors, terminal
from rp_jax.cli.choice import AgentChoice, chosen
from rp_jax.runs.certify import certify
from rp_jax.validate import number


@dataclass(frozen=True, kw_only=True)
class CertifyOptions(AgentChoice):
    """Options of `rp-jax certify`."""

    c: float  # crash rate not to be exceeded
    confidence: float = 0.99  # of the statement
    expected: float | None = None  # crash rate that shall pass with 90 %; default: c / 2
    out: Path | None = None  # JSON file for the statement

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        super().validate()
        number("c", self.c, above=0)
        number("confidence", self.confidence, above=0)


def main(argv: Sequence[str]) -> None:
    """Runs the command; exits with 1 where nothing is shown, with 2 on bad input.

    Args:
        argv: arguments after "certify".
    """
    config = tyro.cli(CertifyOptions, args=list(argv), prog="rp-jax certify", description=__doc__)
    with errors.bad_input():
        errors.needs_folder(config.out)
        found = chosen(config)

        def planned(episodes: int, allowed: int) -> None:
            terminal.say(
                f"plan: {episodes:,} episodes of {found.name} {found.variant}; {allowed} crashes "
                f"or fewer show a rate of at most {config.c:g} at {100 * config.confidence:g} % "
                "confidence"
            )

        began = time.perf_counter()
        with terminal.progress() as bar:
            certificate = certify(
                jax.random.key(config.seed),
                found.agents,
                c=config.c,
                confidence=config.confidence,
                expected=config.expected,
                agent=config.agent,
                on_plan=planned,
                on_progress=bar,
            )
        row = {
            **dataclasses.asdict(certificate),
            **found.about,
            "shown": certificate.shown,
            "agent": config.agent,
            "seed": config.seed,
            "version": rp_jax.__version__,
            "seconds": time.perf_counter() - began,
        }
        if config.out is not None:
            storage.write_json(config.out, row)
    line = str(certificate).replace(
        f"{certificate.env}, ", f"{found.name} {found.variant}, {found.sha256[:16]}, ", 1
    )
    terminal.say(line, style="green" if certificate.shown else "yellow")
    raise SystemExit(0 if certificate.shown else 1)
