"""The command line of an experiment: a preset, and any setting overridden."""

import argparse
import dataclasses
import importlib.util
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import tyro

from experiments import console, pipeline
from experiments.recipes import RECIPES

C = TypeVar("C")


def main(
    name: str,
    about: str,
    presets: Mapping[str, Callable[[str], Any]],
    make_task: Callable[[Any], pipeline.Task],
    argv: Sequence[str] | None = None,
) -> Path:
    """Runs an experiment from the command line; exits with 2 on bad input.

    Args:
        name: of the module, for --help.
        about: what it does, for --help.
        presets: by name, functions from a recipe's name to a configuration.
        make_task: from a configuration to the task.
        argv: arguments, the process's own if not given.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default="quick")
    first.add_argument("--recipe", default=RECIPES[0])
    chosen, rest = first.parse_known_args(argv)
    with bad_input():
        preset = presets[_among("preset", chosen.preset, presets)]
        config = preset(_among("recipe", chosen.recipe, RECIPES))
        text = (
            f"{about}\n\n--preset {{{','.join(presets)}}} (default quick) and --recipe "
            f"{{{','.join(RECIPES)}}} (default {RECIPES[0]}) choose the values below; any of "
            "them can be overridden."
        )
        config = tyro.cli(
            type(config), default=config, args=rest, prog=f"python -m {name}", description=text
        )
        if config.figures and importlib.util.find_spec("matplotlib") is None:
            raise ValueError(
                "figures is True; it needs matplotlib (pip install 'rp_jax[plot]'), or say "
                "--no-figures"
            )
        return pipeline.run(make_task, config, chosen.preset)


@contextmanager
def bad_input() -> Iterator[None]:
    """Turns a ValueError into a message and exit code 2, an interruption into one and 130."""
    try:
        yield
    except ValueError as error:
        console.console.print(f"[red]error:[/red] {error}", highlight=False, soft_wrap=True)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        console.console.print("[yellow]interrupted[/yellow]: what was finished is kept")
        raise SystemExit(130) from None


def _among(field: str, value: str, allowed: Any) -> str:
    if value not in allowed:
        raise ValueError(f"{field} is {value!r}; it must be one of {', '.join(allowed)}")
    return value


def override(config: C, **changes: Any) -> C:
    """A copy with some fields changed; nested ones are named a__b."""
    nested: dict[str, dict[str, Any]] = {}
    flat = {}
    for name, value in changes.items():
        head, _, tail = name.partition("__")
        if tail:
            nested.setdefault(head, {})[tail] = value
        else:
            flat[name] = value
    for head, inner in nested.items():
        flat[head] = override(getattr(config, head), **inner)
    return dataclasses.replace(config, **flat)  # type: ignore[type-var]
