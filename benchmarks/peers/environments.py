"""Environments of their own for peers, so that what they need never meets what rp_jax needs."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.measure import Row

ROOT = Path(__file__).resolve().parents[2]
STAMP = "installed.txt"  # names what an environment was made for, once it is whole


class UnavailableError(RuntimeError):
    """A peer cannot be installed or does not run; says why, in a line."""


def _run(command: Sequence[str | Path], seconds: float) -> None:
    """Runs a command from the root of the checkout.

    Raises:
        UnavailableError: it fails, or takes longer than `seconds`.
    """
    try:
        done = subprocess.run(
            [str(part) for part in command],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=seconds,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise UnavailableError(str(error)) from None
    if done.returncode != 0:
        said = (done.stderr.strip() or done.stdout.strip() or "no message").splitlines()
        raise UnavailableError(f"exit {done.returncode}: {said[-1]}")


def made(cache: Path, name: str, requirements: Sequence[str], seconds: float = 1800) -> Path:
    """The interpreter of an environment with rp_jax and `requirements`, made if it is not there.

    Args:
        cache: folder of the environments.
        name: of the environment.
        requirements: as pip takes them.
        seconds: after which an installation is given up.

    Raises:
        UnavailableError: it cannot be made.
    """
    folder = (cache / name).resolve()
    python, stamp = folder / "bin" / "python", folder / STAMP
    wanted = "\n".join(requirements)
    if stamp.is_file() and stamp.read_text() == wanted:
        return python
    _run([sys.executable, "-m", "venv", folder], 120)
    here = ["--editable", f"{ROOT}[gymnasium]"]
    _run([python, "-m", "pip", "install", "--quiet", *here, *requirements], seconds)
    stamp.write_text(wanted)
    return python


def measured(python: Path, module: str, seconds: float = 600) -> list[Row]:
    """The rows that `module` writes when that interpreter runs it.

    Raises:
        UnavailableError: it fails, or takes longer than `seconds`.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows.json"
        _run([python, "-m", module, file], seconds)
        rows: list[dict[str, Any]] = json.loads(file.read_text())
    return [Row(**row) for row in rows]


def write(rows: Sequence[Row]) -> None:
    """Leaves rows in the file that the command line names: the other end of `measured`."""
    plain = [{**vars(row), "bound": None} for row in rows]
    Path(sys.argv[1]).write_text(json.dumps(plain))
