"""kill -9 in every stage: a resumed run comes to the bits of one that was left alone."""

import killed
import pytest

KILLS = 25


@pytest.mark.slow
def test_killed_runs_come_to_the_same_bits(tmp_path):
    hits, finished = killed.campaign(KILLS, 0, tmp_path)
    assert sum(hits.values()) >= KILLS
    assert finished >= 1
    assert {name.split(",")[0] for name in hits} >= {"labels", "planning"}
    assert any("at a write" in name for name in hits)
