"""Quick compilation, for tests whose programs run for a moment only."""

from contextlib import contextmanager

import jax
import pytest

from rp_jax import checkpoints
from rp_jax.checkpoints import Checkpoints


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


@contextmanager
def stopped_after(steps, monkeypatch):
    """In here a loop with checkpoints, one for each step, is interrupted after so many."""
    save = Checkpoints._save

    def stop(self, done, *rest):
        save(self, done, *rest)
        if done == steps:
            raise KeyboardInterrupt(f"{done} done")

    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "INTERVAL", 0.0)
        patch.setattr(checkpoints, "SHARE", float("inf"))
        patch.setattr(Checkpoints, "_save", stop)
        yield
