import jax
import pytest


@pytest.fixture(autouse=True, scope="module")
def double_precision():
    """Exact solutions are compared in double precision."""
    with jax.enable_x64(True):
        yield
