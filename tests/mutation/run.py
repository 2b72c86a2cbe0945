"""Plants the bugs of `mutants.py` one by one in a copy of the checkout, and runs their tests.

    python tests/mutation/run.py                    # all; some 20 minutes
    python tests/mutation/run.py shield "no Double"  # those whose file or name holds a word

A bug that no test notices survives: then the tests have to become better.
"""

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mutants import MUTANTS, Mutant

ROOT = Path(__file__).parents[2]


def copied(folder: Path) -> Path:
    """Returns a copy of the checkout: what git tracks, as it is on the disk."""
    found = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    for name in found.stdout.split("\0"):
        if name and (ROOT / name).exists() and not name.startswith("docs/results/"):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    (folder / "docs" / "results").symlink_to(ROOT / "docs" / "results")
    return folder


def caught(mutant: Mutant, checkout: Path, cache: Path) -> tuple[bool, str]:
    """Returns whether a test fails under the bug, and the last line that pytest prints."""
    file = checkout / mutant.file
    sound = file.read_text()
    assert sound.count(mutant.old) == 1, f"{mutant.file}: {mutant.name} cannot be planted"
    file.write_text(sound.replace(mutant.old, mutant.new))
    try:
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-x", "-q", *shlex.split(mutant.tests)],
            cwd=checkout,
            env={
                **os.environ,
                "PYTHONPATH": str(checkout),
                "PYTHONDONTWRITEBYTECODE": "1",
                "JAX_COMPILATION_CACHE_DIR": str(cache),
                "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.5",
            },
            capture_output=True,
            text=True,
            timeout=1800,
        )
    finally:
        file.write_text(sound)
    lines = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return done.returncode == 1, (lines or done.stdout.splitlines() or [""])[-1][:160]


def main() -> int:
    """Returns 1 if a bug survived."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("word", nargs="*", help="part of a file's or a bug's name")
    words = parser.parse_args().word
    chosen = [m for m in MUTANTS if not words or any(w in m.file or w in m.name for w in words)]
    survived = []
    with tempfile.TemporaryDirectory() as folder:
        checkout = copied(Path(folder) / "checkout")
        for mutant in chosen:
            began = time.perf_counter()
            dead, line = caught(mutant, checkout, Path(folder) / "cache")
            survived += [] if dead else [mutant]
            word = "caught  " if dead else "SURVIVED"
            seconds = time.perf_counter() - began
            print(f"{word} {seconds:4.0f} s  {mutant.file}: {mutant.name}  [{line}]", flush=True)
    print(f"{len(chosen) - len(survived)} of {len(chosen)} caught")
    return 1 if survived else 0


if __name__ == "__main__":
    sys.exit(main())
