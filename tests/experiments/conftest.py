import pytest
from tiny import go, moment


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """A whole run of Circuit, two seeds, without figures."""
    out = tmp_path_factory.mktemp("results") / "circuit"
    with moment():
        return go("circuit", out, "--no-figures --track circle --test-tracks circle")


@pytest.fixture(scope="session")
def drawn(tmp_path_factory):
    """A whole run of Jam, with figures."""
    out = tmp_path_factory.mktemp("results") / "jam"
    with moment():
        return go("jam", out, "--obstacles 3 --test-obstacles 3")
