"""What is shown where no terminal is."""

import os
import subprocess
import sys

import pytest

from rp_jax.cli import terminal

ODD = "fog [light] [/red] :car: a_b"  # a name that rich would read as markup and as a picture
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


@pytest.fixture
def shown(monkeypatch, capsys):
    """What is on a terminal of 200 columns, its spaces joined."""
    monkeypatch.setenv("COLUMNS", "200")
    terminal.console.cache_clear()
    yield lambda: " ".join(capsys.readouterr().out.split())
    terminal.console.cache_clear()


def test_a_line_is_shown_as_it_is(shown):
    terminal.say(f"error: {ODD}", style="red")
    assert shown() == f"error: {ODD}"
    long = "word " * 100
    terminal.say(long.strip())
    assert shown() == long.strip()


def test_a_table_shows_texts_as_they_are(shown):
    terminal.table(f"title {ODD}", [{f"column {ODD}": f"cell {ODD}"}], [f"column {ODD}"])
    said = shown()
    for part in ("title", "column", "cell"):
        assert f"{part} {ODD}" in said


def test_progress_shows_texts_as_they_are(shown):
    with terminal.progress(f"name {ODD}") as bar:
        bar(f"stage {ODD}", 1, 2, f"note {ODD}")
    said = shown()
    assert f"name {ODD}: stage {ODD}" in said
    assert f"note {ODD}" in said


def test_without_any_output_nothing_is_shown_and_nothing_fails():
    code = (
        "import sys; sys.stdout = sys.stderr = None\n"
        "from rp_jax.cli import terminal\n"
        "terminal.say('line', style='red'); terminal.table('t', [{'a': 1.0}], ['a'])\n"
        "with terminal.progress() as bar: bar('stage', 1, 2)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
