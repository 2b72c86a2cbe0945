"""Quick compilation, for tests whose programs run for a moment only."""

from contextlib import contextmanager

import jax
import pytest


@contextmanager
def unoptimised():
    """Programs compiled in here are ready sooner, and run slower."""
    jax.config.update("jax_disable_most_optimizations", True)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(autouse=True, scope="module")
def compile_soon():
    """For all tests of a module that imports this."""
    with unoptimised():
        yield
