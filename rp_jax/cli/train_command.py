"""Learns threats and agents for a world, and evaluates them, into one folder.

rp-jax train --env rp_jax.envs.jam --set num_obstacles=8 --test N=3:num_obstacles=3

rp-jax train --env my_package.world --out results/mine --seeds 3 --penalty 50
"""

import argparse
import dataclasses
from collections.abc import Sequence
from typing import Any, cast

from rp_jax import recipes
from rp_jax.cli import errors, experiment
from rp_jax.cli.choice import parsed_settings
from rp_jax.cli.experiment import Experiment
from rp_jax.envs.check import check_contract
from rp_jax.runs import record
from rp_jax.runs.saved import imported
from rp_jax.runs.train import TrainConfig, World
from rp_jax.threat.build import ThreatConfig

NAME = "rp-jax train"
WORLDS = (  # for --help
    "--env MODULE is the world; --set KEY=VALUE ... are settings of its make_params "
    "while learning, --test NAME:KEY=VALUE,... those that differ in a test. With --env, --help "
    "also lists the settings of the threat function of each kind of hazard."
)


def config_of(world: World) -> TrainConfig:
    """Returns the settings of a run, with those of a threat model for each kind of hazard.

    Args:
        world: what is learned.

    Raises:
        ValueError: the world breaks the contract, or a kind has the name of a setting.
    """
    params = world.params()
    check_contract(world.env, params)
    fields: list[Any] = []
    for kind, sub in world.env.sub_rmdps(params).items():
        if not kind.isidentifier() or kind in TrainConfig.__dataclass_fields__:
            raise ValueError(
                f"kind of hazard is {kind!r}; it must be a word that is no setting of a run"
            )
        default = recipes.tuned(sub)
        fields.append((kind, ThreatConfig, dataclasses.field(default=default)))
    kind_of = dataclasses.make_dataclass("Config", fields, bases=(TrainConfig,), frozen=True)
    return kind_of()


def world_from(argv: Sequence[str]) -> tuple[World, list[str]]:
    """Returns the world that options name, and the other options.

    Args:
        argv: arguments.

    Raises:
        ValueError: there is no such world, or a setting is not one of its `make_params`.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--env", required=True)
    parser.add_argument("--set", nargs="*", action="extend", default=[])
    parser.add_argument("--test", nargs="*", action="extend", default=[])
    if not _names_env(argv):
        raise ValueError("env is missing; it must be a module, such as --env my_package.world")
    found, rest = parser.parse_known_args(list(argv))
    env = imported(found.env)
    if not hasattr(env, "make_params"):
        raise ValueError(f"env is {found.env}; it must have a function make_params(**settings)")
    settings, tests = parsed_settings(found.set), {}
    for word in found.test:
        name, colon, changes = word.partition(":")
        if not colon or not name:
            raise ValueError(f"test is {word!r}; it must be NAME:KEY=VALUE,KEY=VALUE")
        tests[name] = {**settings, **parsed_settings(changes.split(",") if changes else [])}
    world = World(record.short_name(env), env, settings, tests or {"": dict(settings)})
    for given in (world.settings, *world.tests.values()):
        try:
            env.make_params(**given)
        except TypeError as error:
            raise ValueError(f"set is {given}; it must fit make_params ({error})") from error
    return world, rest


def _names_env(argv: Sequence[str]) -> bool:
    return any(word == "--env" or word.startswith("--env=") for word in argv)


def settings_from(argv: Sequence[str]) -> tuple[World | None, TrainConfig, list[str]]:
    """Returns the world, its settings, and the other options; exits with 2 on bad input.

    Args:
        argv: arguments; with --help alone there is no world, and only settings that all have.
    """
    folder = experiment.to_resume(argv)
    with errors.bad_input():
        if folder is not None:
            world, rest = experiment.world_of(folder), list(argv)
        elif set(argv) & {"-h", "--help"} and not _names_env(argv):
            return None, TrainConfig(), ["--help"]
        else:
            world, rest = world_from(argv)
        config = config_of(world)
    return world, config, rest


def main(argv: Sequence[str]) -> None:
    """Runs the command.

    Args:
        argv: arguments after "train".
    """
    world, config, rest = settings_from(argv)
    experiment.run(
        Experiment(
            name=NAME,
            about=f"{__doc__}\n{WORLDS}",
            presets={"default": lambda recipe: config},
            make_world=lambda config: cast(World, world),
            recipes=("tuned",),
        ),
        rest,
    )
