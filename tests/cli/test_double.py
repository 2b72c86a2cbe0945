"""Experiments in double precision, which is the process's: each is one of its own."""

import json
import os
import subprocess
import sys

import pytest
from tiny import TINY, TINY_THREAT

WORDS = {
    "circuit": f"{TINY_THREAT.format('wall')} --track circle --test-tracks circle",
    "jam": f"{TINY_THREAT.format('obstacle')} --baseline plans --lookahead 2 --obstacles 2 "
    "--test-obstacles 2",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", WORDS)
def test_a_run_in_double_precision(name, tmp_path):
    words = f"-m experiments.{name} {TINY} {WORDS[name]} --no-figures --out {tmp_path / 'run'}"
    env = os.environ | {"JAX_ENABLE_X64": "1"}
    subprocess.run([sys.executable, *words.split()], env=env, check=True)
    assert len(json.loads((tmp_path / "run" / "table.json").read_text())) == 2
