"""The command `rp-jax rare`, from a checkout: python -m experiments.rare --help."""

import sys

from rp_jax.cli import rare_command

if __name__ == "__main__":
    rare_command.main(sys.argv[1:])
