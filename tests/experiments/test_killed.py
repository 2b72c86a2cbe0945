"""kill -9 at any moment: a resumed run comes to the bits of one that was left alone.

RP_KILLS sets the number of kills.
"""

import os

import killed
import pytest

KILLS = int(os.environ.get("RP_KILLS", "4"))


@pytest.mark.slow
def test_killed_runs_come_to_the_same_bits(tmp_path):
    hits, finished = killed.campaign(KILLS, 0, tmp_path)
    assert sum(hits.values()) >= KILLS
    assert finished >= 1
    assert len({name.split(",")[0] for name in hits}) > 1  # stages
