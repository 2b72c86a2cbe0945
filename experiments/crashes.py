"""The command `rp-jax crashes`, from a checkout: python -m experiments.crashes --help."""

import sys

from rp_jax.cli import crashes_command

if __name__ == "__main__":
    crashes_command.main(sys.argv[1:])
