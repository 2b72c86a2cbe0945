import fcntl
import gc
import os
import tempfile
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import settings

from rp_jax.recon.labels import exact_threat, monte_carlo_threat

PATHS = 4096
MAPS = Path("/proc/self/maps")  # where the system has it

jax.config.update("jax_numpy_rank_promotion", "raise")
settings.register_profile("rp_jax", deadline=None, derandomize=True, database=None, max_examples=30)
settings.load_profile("rp_jax")


def pytest_configure(config):
    """All processes of a run of the tests, and those that tests begin, compile a program once."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        programs = tempfile.TemporaryDirectory(prefix="programs-")
        config.add_cleanup(programs.cleanup)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = programs.name  # of processes that begin later
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.5"
        jax.config.update("jax_compilation_cache_dir", programs.name)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def pytest_collection_modifyitems(items):
    """Files with slow tests first, so that several processes end together."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """Compiled programs stay mapped in memory, and Linux allows a process 65,530 maps."""
    yield
    if MAPS.exists() and len(MAPS.read_bytes().splitlines()) > 20_000:
        jax.clear_caches()
        gc.collect()


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


def of_any_speeds(sub):
    """Only the ends of the speeds matter to a label: one compilation serves all vehicles."""
    ends = sub.body.speeds[np.asarray([0, -1])]
    return sub.replace(body=sub.body.replace(speeds=ends))


@pytest.fixture(scope="session")
def exact():
    """(features (n, F), sub) -> Labels (n, A), by enumeration."""

    @jax.jit
    def label(features, sub):
        def one(row):
            return exact_threat(jax.random.key(0), *sub.source.state_of(row), sub)

        return jax.lax.map(one, features, batch_size=50)

    return lambda features, sub: label(features, of_any_speeds(sub))


@pytest.fixture(scope="session")
def monte_carlo():
    """(key, features (n, F), sub) -> Labels (n, A), from 4,096 paths each."""

    @jax.jit
    def label(key, features, sub):
        def one(row):
            key, features = row
            return monte_carlo_threat(key, *sub.source.state_of(features), sub, PATHS)

        return jax.lax.map(one, (jax.random.split(key, len(features)), features))

    return lambda key, features, sub: label(key, features, of_any_speeds(sub))


def once(tmp_path_factory, name, *options):
    """The folder of a whole run, made by one of pytest's processes for all of them."""
    from tiny import go, moment

    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "whole" / name
    folder.parent.mkdir(exist_ok=True)
    with folder.with_suffix(".lock").open("a+") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not lock.seek(0, os.SEEK_END):  # as it is now that the lock is held
            with moment():
                go(name, folder, *options)
            lock.write("made")
    return folder


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """A whole run of Circuit, two seeds, without figures."""
    return once(tmp_path_factory, "circuit", "--no-figures --track circle --test-tracks circle")


@pytest.fixture(scope="session")
def drawn(tmp_path_factory):
    """A whole run of Jam, with figures."""
    return once(tmp_path_factory, "jam", "--obstacles 3 --test-obstacles 3")
