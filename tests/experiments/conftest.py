import fcntl
import os

import pytest
from tiny import go, moment


def once(tmp_path_factory, name, *options):
    """The folder of a whole run, made by one of pytest's processes for all of them."""
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
