"""The command `rp-jax`, and what command lines of experiments share."""
