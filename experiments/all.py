"""Every figure and table of the paper, and what goes beyond it, with a report.

Each result has a folder in --out, and so has each run that results are taken from, in --out/runs.
What is finished is not done again: --resume DIR goes on where it was stopped, and with --only
makes some results (or runs) alone. Several processes may work in one folder: a run is made by one
of them, and what needs it fails in the others until it is finished.

python -m experiments.all --preset quick
"""

import gc
import os
import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import tyro

from experiments import report
from experiments.paper import (
    ablations,
    brief,
    crowds,
    fig2,
    fig3,
    fig4,
    fig5,
    fig6,
    more_steps,
    paper_recipe,
    published,
    second_reward,
    table1,
    table2,
    tables3_4,
    theorems,
    thresholds,
    timing,
    training_crashes,
    walls,
)
from experiments.paper.commands import COMMANDS, SIZES
from experiments.paper.scores import read
from experiments.paper.section import CLOSE, Section
from experiments.paper.sources import LOG, RunError, Sources
from rp_jax import storage
from rp_jax.cli import errors, terminal
from rp_jax.cli.experiment import default_out
from rp_jax.runs import record
from rp_jax.validate import one_of

MODULES: tuple[ModuleType, ...] = (
    *(fig2, fig3, fig4, fig5, fig6, table1, table2, tables3_4, timing, brief, theorems),
    *(training_crashes, more_steps, paper_recipe, thresholds, crowds, second_reward, ablations),
    walls,
)
RESULTS: dict[str, Any] = {module.__name__.rpartition(".")[2]: module for module in MODULES}
NAME = "python -m experiments.all"


@dataclass(frozen=True)
class Config:
    """Settings of the command: which results are made, and where."""

    preset: str | None = None  # quick (the default) or full
    only: tuple[str, ...] = ()  # results, or runs that they are taken from; default: all results
    out: Path | None = None  # folder for results; default: results/paper-PRESET-TIME
    resume: Path | None = None  # folder to go on in; the preset is the one that it was begun with


def begun(config: Config) -> tuple[str, Path]:
    """Returns the preset and the folder: a new one, or one to go on in.

    Raises:
        ValueError: a setting is out of range, or the folder cannot be used.
    """
    for name in config.only:
        one_of("only", name, [*RESULTS, *COMMANDS])
    errors.needs_matplotlib()
    if config.resume is None:
        preset = one_of("preset", config.preset or "quick", SIZES)
        folder = storage.new_folder(config.out or default_out(f"paper-{preset}"))
        plain = {"experiment": NAME, "preset": preset, **record.machine(None)}
        storage.write_json(folder / "config.json", plain)
        return preset, folder
    if config.preset or config.out:
        raise ValueError(f"resume is {config.resume}; only --only may be given with it")
    found = record.read_json(config.resume / "config.json")
    if found.get("experiment") != NAME:
        raise ValueError(f"resume is {config.resume}; it must be a folder of {NAME}")
    return one_of("preset", str(found.get("preset")), SIZES), config.resume


def make(names: Sequence[str], sources: Sources, folder: Path) -> dict[str, str]:
    """Makes results and runs, one after another; returns what failed, and why."""
    failed = {}
    for name in names:
        terminal.say(f"== {name}", style="bold")
        try:
            if name in RESULTS:
                result(RESULTS[name], sources, folder / name)
            else:
                sources(name)
        except (RunError, storage.StorageError) as error:
            failed[name] = str(error)
        except Exception as error:  # whatever it is, the others are not to suffer
            traceback.print_exc()
            failed[name] = f"{type(error).__name__}: {error}"
        jax.clear_caches()
        gc.collect()
    return failed


def result(module: Any, sources: Sources, folder: Path) -> None:
    """Makes one result, unless it is saved already; draws its figures, and lets it tell."""
    saved = folder / "results.json"
    if not saved.exists():
        folder.mkdir(exist_ok=True)
        storage.write_json(saved, module.run(sources, folder))
    if hasattr(module, "plot"):
        module.plot(read(saved), folder)
    told(module, folder)


def told(module: Any, folder: Path) -> Section:
    """Returns the section of the report on a saved result.

    Raises:
        FileNotFoundError: a figure of it was not drawn.
    """
    section = module.tell(read(folder / "results.json"))
    for name in section.figures:
        if not (folder / name).exists():
            raise FileNotFoundError(f"{folder / name}: it was not drawn")
    return section


def all_told(folder: Path, failed: dict[str, str]) -> dict[str, Section]:
    """Returns the sections on all saved results; what cannot be told joins those that failed."""
    found = {}
    for name, module in RESULTS.items():
        if name not in failed and (folder / name / "results.json").exists():
            try:
                found[name] = told(module, folder / name)
            except Exception as error:  # of other code, or half made: the others are told
                failed[name] = f"{type(error).__name__}: {error}"
    return found


def blocks(folder: Path, preset: str, failed: dict[str, str]) -> list[report.Block]:
    """Returns the report on all results that are saved in the folder."""
    told = all_told(folder, failed)
    claims = [claim for section in told.values() for claim in section.claims]
    counts = Counter(claim.verdict.partition(" (")[0] for claim in claims)
    missing = [name for name in RESULTS if name not in told and name not in failed]
    machine = record.machine(None)
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    out: list[report.Block] = [
        report.Heading("The paper's figures and tables, and more", 1),
        f"Preset {preset}; report by {versions}, {os.cpu_count()} cores, {machine['device']}; "
        "what was run for it, at the end. "
        "Crash rates have 95 % intervals of Clopper and Pearson, over the episodes of all seeds "
        "pooled; returns, Student's over seeds, or over episodes where there is one seed.",
        f"{len(claims)} verdicts: "
        + "; ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items()))
        + ". Where the paper has a number of RP, each kind of RP here has a verdict. Several seeds "
        "have exceeded a published return if their whole interval lies above it; a return is "
        "reproduced if the mean reaches it, or the interval does and the mean falls short by at "
        f"most {100 * CLOSE:g} %. A crash rate reproduces the published one, which has two "
        "digits, if its whole interval does not exceed it as rounded.",
        report.verdicts(claims, "All verdicts"),
    ]
    for name, section in told.items():
        out += report.section(name, RESULTS[name].TITLE, section)
    if missing:
        out += [report.Heading("Not made yet"), ", ".join(missing)]
    if failed:
        out += [report.Heading("Failed"), *(f"{name}: {why}" for name, why in failed.items())]
    lines = ledger(folder / "runs")
    hours, cpu = (sum(float(line[k]) for line in lines) / 60 for k in ("minutes", "CPU minutes"))
    took = (
        f"{len(lines)} runs took {hours:.1f} hours one after another, {cpu:.1f} CPU hours. The "
        f"paper: {published.TRAINING_HOURS:g} hours on a GPU for one seed of one task."
    )
    return [*out, report.Heading("What was run"), took, report.Grid("Runs", lines)]


def ledger(folder: Path) -> list[dict[str, Any]]:
    """Returns a line per run: command, commit, and what it took in all its processes."""
    lines = []
    for name in COMMANDS:
        if (folder / name / LOG).exists():
            log = read(folder / name / LOG)
            lines.append(
                {
                    "run": name,
                    "command": log[0]["command"],
                    "commit": ", ".join(dict.fromkeys(entry["commit"] for entry in log)),
                    "CPU minutes": f"{sum(entry['cpu_seconds'] for entry in log) / 60:.1f}",
                    "minutes": f"{sum(entry['seconds'] for entry in log) / 60:.1f}",
                }
            )
    return lines


class Terminated(BaseException):
    """There was a SIGTERM: raised wherever the process is, so that it ends its child too."""


def _terminate(*_: Any) -> None:
    raise Terminated


def main(argv: Sequence[str] | None = None) -> Path:
    """Runs the command; exits with 1 if a result failed, 2 on bad input.

    It exits with 130 on Ctrl-C, and with 143 on SIGTERM, which ends the running process too.
    """
    config = tyro.cli(Config, prog=NAME, description=__doc__, args=argv)
    with errors.bad_input():
        preset, folder = begun(config)
    sources = Sources(folder / "runs", preset)
    try:
        with errors.on_sigterm(_terminate):
            failed = make(config.only or tuple(RESULTS), sources, folder)
    except (KeyboardInterrupt, Terminated) as stop:
        terminal.say(f"to go on: {NAME} --resume {folder}", style="yellow")
        code = errors.TERMINATED if isinstance(stop, Terminated) else 130
        raise SystemExit(code) from None
    report.write(folder, blocks(folder, preset, failed))
    terminal.say(f"results: {folder / 'report.html'}")
    for name, why in failed.items():
        terminal.say(f"failed: {name}: {why}", style="red")
    if failed:
        raise SystemExit(1)
    return folder


if __name__ == "__main__":
    main()
