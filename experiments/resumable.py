"""Command lines with settings of their own whose runs go on after an interruption."""

import dataclasses
import functools
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from rp_jax import storage
from rp_jax.cli import errors, experiment, terminal
from rp_jax.runs import record
from rp_jax.runs.dataclass_json import restored
from rp_jax.runs.train import with_own_threat


class Command(NamedTuple):
    """A command; its settings are a dataclass with a field `out`, and so is its config.json."""

    name: str  # how it is called: "python -m experiments.mpc"
    about: str  # for --help
    settings: type  # a dataclass, whose defaults are those of the options
    prepare: Callable[[Any], Any]  # checks the settings before any work; what it returns is `ready`
    title: Callable[[Any], str]  # of the default folder, from the settings
    job: Callable[[Any, Any, Path], None]  # (settings, ready, folder)
    facts: Callable[[Any], dict[str, Any]] = lambda ready: {}  # more for config.json, from `ready`
    keep: Callable[[Any, Path], None] = lambda ready, folder: None  # copies what a resume needs


def main(command: Command, argv: Sequence[str]) -> Path:
    """Runs a command, or goes on with --resume DIR; exits with 2 on bad input.

    Args:
        command: what is run.
        argv: arguments.

    Returns:
        The folder of the results.
    """
    argv, folder = list(argv), experiment.to_resume(argv)
    module = sys.modules[command.settings.__module__]  # its source counts as that of the job
    with errors.bad_input():
        if folder is not None:
            plain = experiment.interrupted(folder, command.name, module, argv)
            settings: Any = restored(command.settings, plain, str(folder / "config.json"))
            if hasattr(settings, "threat"):
                settings = with_own_threat(settings, folder)
            ready = command.prepare(settings)
        else:
            settings = tyro.cli(
                command.settings, args=argv, prog=command.name, description=command.about
            )
            ready = command.prepare(settings)
            out = settings.out or experiment.default_out(command.title(settings))
            folder = storage.new_folder(out)
            facts = {"experiment": command.name, **dataclasses.asdict(settings)}
            facts |= {**command.facts(ready), **record.machine(module)}
            experiment.begin(folder, facts, functools.partial(command.keep, ready, folder))
    again, checkpoints = f"{command.name} --resume {folder}", folder / record.CHECKPOINTS
    with errors.resumable(again, folder, lambda: shutil.rmtree(checkpoints)):
        command.job(settings, ready, folder)
    terminal.say(f"results: {folder}")
    return folder
