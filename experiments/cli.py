"""The command line of an experiment: a preset, and any setting overridden."""

import argparse
import dataclasses
import importlib.util
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import tyro

from experiments import console, pipeline, settings, tasks
from experiments.recipes import RECIPES
from rp_jax import storage
from rp_jax.checkpoints import Checkpoints
from rp_jax.validate import one_of

NO_FIGURES = ", or say --no-figures"


def main(
    name: str,
    about: str,
    presets: Mapping[str, Callable[[str], Any]],
    make_task: Callable[[Any], tasks.Task],
    argv: Sequence[str] | None = None,
    run: Callable[[tasks.Task, Any, Path, Checkpoints], None] | None = None,
) -> Path:
    """Runs an experiment from the command line; exits with 2 on bad input.

    Args:
        name: of the module, for --help.
        about: what it does, for --help.
        presets: by name, functions from a recipe's name to a configuration.
        make_task: from a configuration to the task.
        argv: arguments, the process's own if not given.
        run: does the job with (task, configuration, folder, checkpoints); `pipeline.run` if not
            given.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default="quick")
    first.add_argument("--recipe", default=RECIPES[0])
    chosen, rest = first.parse_known_args(argv)
    folder = to_resume(argv)
    with bad_input():
        preset = presets[one_of("preset", chosen.preset, presets)]
        config = preset(one_of("recipe", chosen.recipe, RECIPES))
        if folder is not None:
            config, checkpoints = resumed(name, folder, type(config), argv)
            task = pipeline.checked(make_task, config)
        else:
            config = tyro.cli(
                type(config),
                default=config,
                args=rest,
                prog=f"python -m {name}",
                description=_description(about, presets),
            )
            needs_matplotlib(config.figures, NO_FIGURES)
            task, folder = pipeline.prepare(make_task, config, chosen.preset)
            plain = {"preset": chosen.preset, "task": task.name, **dataclasses.asdict(config)}
            checkpoints = settings.begin(folder, name, plain)
    with resumable(name, folder, checkpoints):
        (run or pipeline.run)(task, config, folder, checkpoints)
    return folder


def to_resume(argv: Sequence[str]) -> Path | None:
    """DIR of --resume DIR, if that is given."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--resume", type=Path)
    return parser.parse_known_args(argv)[0].resume


def resumed(name: str, folder: Path, kind: type, argv: Sequence[str]) -> tuple[Any, Checkpoints]:
    """Settings and checkpoints of an interrupted run.

    Args:
        name: of the module that is to go on with it.
        folder: of the run.
        kind: of the settings.
        argv: all arguments.

    Raises:
        ValueError: there are other arguments, or the run cannot be resumed by this module.
    """
    if len(argv) > (2 if argv[0] == "--resume" else 1):  # --resume DIR, --resume=DIR
        raise ValueError(
            f"resume is {folder}; no other option may be given with it: the settings are those in "
            "its config.json"
        )
    plain = settings.interrupted(folder, name)
    if plain.get("devices") == "cluster":
        raise ValueError(f"resume is {folder}; its devices is 'cluster'; it must be 'one' or 'all'")
    config = settings.restored(kind, plain, str(folder / "config.json"))
    return config, settings.checkpoints_of(folder)


@contextmanager
def resumable(name: str, folder: Path, checkpoints: Checkpoints) -> Iterator[None]:
    """Around a run: says how to go on if it is stopped, exits with 130 (Ctrl-C) or 1 (an error).

    Exits with 2 if another process is at work on the run.
    """
    again = f"to go on: python -m {name} --resume {folder}"
    with ExitStack() as stack:
        with bad_input():
            stack.enter_context(storage.locked(folder, settings.LOCK))
        storage.sweep(folder)
        try:
            yield
        except KeyboardInterrupt as stop:
            console.say(f"interrupted ({stop or 'between two steps'}); {again}", style="yellow")
            raise SystemExit(130) from None
        except (FloatingPointError, OSError, storage.StorageError) as error:
            console.say(f"error: {error}; {again}", style="red")
            raise SystemExit(1) from None
        checkpoints.clear()


def _description(about: str, presets: Mapping[str, Any]) -> str:
    return (
        f"{about}\n\n--preset {{{','.join(presets)}}} (default quick) and --recipe "
        f"{{{','.join(RECIPES)}}} (default {RECIPES[0]}) choose the values below; any of "
        "them can be overridden. --resume DIR, alone, goes on with an interrupted run."
    )


def needs_matplotlib(figures: bool = True, otherwise: str = "") -> None:
    """Raises ValueError if figures are drawn and cannot be; `otherwise` says how to do without."""
    if figures and importlib.util.find_spec("matplotlib") is None:
        raise ValueError(f"figures need matplotlib (pip install 'rp_jax[plot]'){otherwise}")


def needs_folder(out: Path | None) -> None:
    """Raises ValueError if a file that is written at the end could not be."""
    if out is not None and not out.parent.is_dir():
        raise ValueError(f"out is {out}; its folder must exist")


@contextmanager
def bad_input() -> Iterator[None]:
    """Turns a ValueError into a message and exit code 2; numbers that are none, into 1."""
    try:
        yield
    except FloatingPointError as error:
        console.say(f"error: {error}", style="red")
        raise SystemExit(1) from None
    except ValueError as error:
        console.say(f"error: {error}", style="red")
        raise SystemExit(2) from None
