"""The command `rp-jax`: train, evaluate, certify, rare, crashes, frontier, check."""

import importlib
import os
import sys
from collections.abc import Sequence

COMMANDS = {
    "train": "learn threats and agents for a world, and evaluate them",
    "evaluate": "returns and crashes of the agents of a run",
    "certify": "whether an agent's crash rate is at most c",
    "rare": "how rarely an agent crashes, and from which starts most",
    "crashes": "each crash of many episodes, looked at step by step",
    "frontier": "return and crash rate over the threshold x",
    "check": "what is wrong with a world of one's own",
}


def usage() -> str:
    """Returns what the command offers."""
    lines = [f"  {name:9} {about}" for name, about in COMMANDS.items()]
    about = "rp-jax COMMAND --help lists its options"
    return "\n".join(["usage: rp-jax COMMAND [OPTIONS]", "", *lines, "", about])


def main(argv: Sequence[str] | None = None) -> None:
    """Runs a command; exits with 2 if there is no such one.

    Args:
        argv: arguments; those of the process by default.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help"):
        print(usage())
        raise SystemExit(0 if words else 2)
    if words[0] == "--version":
        import rp_jax

        print(rp_jax.__version__)
        return
    if words[0] not in COMMANDS:
        print(f"error: {words[0]!r} is no command\n\n{usage()}", file=sys.stderr)
        raise SystemExit(2)
    if os.getcwd() not in sys.path:  # where a world of one's own is
        sys.path.insert(0, os.getcwd())
    importlib.import_module(f"rp_jax.cli.{words[0]}_command").main(words[1:])
