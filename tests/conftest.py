from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import settings

jax.config.update("jax_numpy_rank_promotion", "raise")
settings.register_profile("rp_jax", deadline=None, derandomize=True, database=None, max_examples=50)
settings.load_profile("rp_jax")


@pytest.fixture(scope="session")
def golden():
    """Reads recorded data by name."""
    folder = Path(__file__).parent / "data"
    return lambda name: dict(np.load(folder / f"{name}.npz"))


@pytest.fixture
def x64():
    """Double precision for one test; build all parameters inside it."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=["float64", "float32"])
def precision(request):
    """Runs a test in both precisions; build all parameters inside it."""
    with jax.enable_x64(request.param == "float64"):
        yield request.param
