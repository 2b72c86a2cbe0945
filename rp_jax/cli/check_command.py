"""Finds what is wrong with a world of one's own, before any threat is learned.

rp-jax check --env my_package.world
"""

import argparse
from collections.abc import Sequence

from rp_jax.cli import errors, terminal, train_command
from rp_jax.envs.check import check_env
from rp_jax.runs.train import check_same_world
from rp_jax.validate import within

OPTIONS = """--env MODULE is the world; --set KEY=VALUE ... are settings of its make_params, and
--test NAME:KEY=VALUE,... those that differ in a test, which is checked as well. --seed N is that
of the random numbers of the check."""


def main(argv: Sequence[str]) -> None:
    """Runs the command; exits with 2 if something is wrong.

    Args:
        argv: arguments after "check".
    """
    if set(argv) & {"-h", "--help"}:
        terminal.say(f"{__doc__}\n{OPTIONS}")
        return
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--seed", default="0")
    given, others = parser.parse_known_args(list(argv))
    with errors.bad_input():
        world, rest = train_command.world_from(others)
        if rest:
            raise ValueError(f"{rest[0]} is no option of rp-jax check; --help lists those it has")
        if not given.seed.isdecimal():
            raise ValueError(f"seed is {given.seed}; it must be an integer, at least 0")
        check_env(world.env, world.params(), seed=int(given.seed))
        for name in filter(None, world.tests):
            with within(f"test {name}"):
                check_same_world(world.env, world.params(), world.params(name), True)
                check_env(world.env, world.params(name), seed=int(given.seed))
    terminal.say(f"{world.name}: nothing wrong was found", style="green")
