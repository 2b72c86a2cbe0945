"""Safe reinforcement learning by reconnaissance and planning, in JAX."""

from importlib.metadata import version

__version__ = version("rp_jax")
