"""The command `rp-jax certify`, from a checkout: python -m experiments.certify --help."""

import sys

from rp_jax.cli import certify_command

if __name__ == "__main__":
    certify_command.main(sys.argv[1:])
