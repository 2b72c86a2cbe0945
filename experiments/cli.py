"""The command line of an experiment: a preset, and any setting overridden."""

import argparse
import importlib.util
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import tyro

from experiments import console, pipeline
from experiments.recipes import RECIPES
from rp_jax.validate import one_of


def main(
    name: str,
    about: str,
    presets: Mapping[str, Callable[[str], Any]],
    make_task: Callable[[Any], pipeline.Task],
    argv: Sequence[str] | None = None,
    run: Callable[[pipeline.Task, Any, str, Path], None] | None = None,
) -> Path:
    """Runs an experiment from the command line; exits with 2 on bad input.

    Args:
        name: of the module, for --help.
        about: what it does, for --help.
        presets: by name, functions from a recipe's name to a configuration.
        make_task: from a configuration to the task.
        argv: arguments, the process's own if not given.
        run: does the job with (task, configuration, preset, new folder); `pipeline.run` if not
            given.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default="quick")
    first.add_argument("--recipe", default=RECIPES[0])
    chosen, rest = first.parse_known_args(argv)
    with bad_input():
        preset = presets[one_of("preset", chosen.preset, presets)]
        config = preset(one_of("recipe", chosen.recipe, RECIPES))
        text = (
            f"{about}\n\n--preset {{{','.join(presets)}}} (default quick) and --recipe "
            f"{{{','.join(RECIPES)}}} (default {RECIPES[0]}) choose the values below; any of "
            "them can be overridden."
        )
        config = tyro.cli(
            type(config), default=config, args=rest, prog=f"python -m {name}", description=text
        )
        needs_matplotlib(config.figures)
        task, folder = pipeline.prepare(make_task, config, chosen.preset)
    try:
        (run or pipeline.run)(task, config, chosen.preset, folder)
    except KeyboardInterrupt:
        console.say(f"interrupted: what was finished is in {folder}", style="yellow")
        raise SystemExit(130) from None
    return folder


def needs_matplotlib(figures: bool) -> None:
    """Raises ValueError if figures are asked for and cannot be drawn."""
    if figures and importlib.util.find_spec("matplotlib") is None:
        raise ValueError(
            "figures is True; it needs matplotlib (pip install 'rp_jax[plot]'), or say --no-figures"
        )


@contextmanager
def bad_input() -> Iterator[None]:
    """Turns a ValueError into a message and exit code 2."""
    try:
        yield
    except ValueError as error:
        console.say(f"error: {error}", style="red")
        raise SystemExit(2) from None
