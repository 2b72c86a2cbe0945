"""kill -9 at any moment: a resumed run comes to the bits of one that was left alone.

RP_KILLS sets the number of kills; 25 of them reach every stage.
"""

import json
import os
import subprocess
import sys
from collections import Counter

import killed
import pytest
from forked import LOOPS

KILLS = int(os.environ.get("RP_KILLS", "25"))


@pytest.mark.slow
def test_killed_runs_come_to_the_same_bits(tmp_path):
    out = tmp_path / "killed.json"
    options = ["--kills", str(KILLS), "--lanes", "2", "--out", str(out)]
    command = [sys.executable, "-W", "error::RuntimeWarning", killed.__file__, *options]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(out.read_text())
    assert found["kills"] == KILLS
    assert found["differing"] == 0
    assert found["runs_to_the_same_bits"] >= 2
    at_writes = Counter({name: n for name, n in found["hits"].items() if "at a write" in name})
    assert sum(at_writes.values()) < KILLS  # the others came at random moments
    for stage in LOOPS:
        assert at_writes[f"{stage}, at a write"] >= 1
