"""Finds what is wrong with a world of one's own, before any threat is learned.

rp-jax check --env my_package.world
"""

from collections.abc import Sequence

from rp_jax.cli import errors, terminal, train_command
from rp_jax.envs.check import check_env


def main(argv: Sequence[str]) -> None:
    """Runs the command; exits with 2 if something is wrong.

    Args:
        argv: arguments after "check": --env MODULE, --set KEY=VALUE ...
    """
    if set(argv) & {"-h", "--help"}:
        terminal.say(f"{__doc__}\n--set KEY=VALUE ... are settings of its make_params")
        return
    with errors.bad_input():
        world, rest = train_command.world_from(argv)
        if rest:
            raise ValueError(f"{rest[0]} is no option of rp-jax check; it must be --env or --set")
        check_env(world.env, world.params())
    terminal.say(f"{world.name}: nothing wrong was found", style="green")
