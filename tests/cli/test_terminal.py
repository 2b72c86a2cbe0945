"""What is shown where no terminal is."""

import os
import subprocess
import sys

import pytest

TABLE = (
    "from rp_jax.cli import terminal; "
    "terminal.table('t', [dict.fromkeys('abcd', 'x' * 30)], 'abcd')"
)


@pytest.mark.parametrize(("columns", "whole"), [(None, True), ("60", False)])
def test_tables_in_files_are_whole_unless_columns_are_set(columns, whole):
    env = {k: v for k, v in os.environ.items() if k != "COLUMNS"}
    env |= {} if columns is None else {"COLUMNS": columns}
    shown = subprocess.run(
        [sys.executable, "-c", TABLE], env=env, capture_output=True, text=True, check=True
    ).stdout
    assert (shown.count("x" * 30) == 4) == whole
