"""Runs that results are taken from: each made once, in a process of its own, and resumed."""

import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from experiments.paper.commands import words
from experiments.paper.scores import read
from rp_jax import storage
from rp_jax.cli import experiment, terminal
from rp_jax.runs import record

LOG = "log.json"  # of a run's processes: command, commit, times, how each ended
ONE_FILE = ("theorems",)  # experiments whose --out is a file


class RunError(RuntimeError):
    """A run ended with an error."""


class Sources:
    """Folders of finished runs, each made when it is first asked for."""

    def __init__(self, folder: Path, preset: str):
        self._folder, self._preset = folder, preset
        self._failed: dict[str, str] = {}

    def __call__(self, name: str) -> Path:
        """The folder of a finished run; makes or resumes the run, and those that it uses, first.

        Raises:
            RunError: it ended with an error, now or earlier in this process.
            storage.StorageError: another process is making it.
            KeyboardInterrupt: it was interrupted.
        """
        folder = self._folder / name
        if name in self._failed:
            raise RunError(self._failed[name])
        place = self._folder / ".locks" / name
        place.mkdir(parents=True, exist_ok=True)
        with storage.locked(place, "lock") as lock:
            if not finished(folder):
                self._make(name, folder, lock)
        return folder

    def _make(self, name: str, folder: Path, lock: int) -> None:
        module, *rest = words(name, self._preset)
        for i, word in enumerate(rest):
            if word.startswith("@"):
                other, _, file = word[1:].partition("/")
                rest[i] = str(self(other) / file)
        log = read(folder / LOG) if (folder / LOG).exists() else []
        if resumable(folder) and goes_on(folder, module):
            rest = ["--resume", str(folder)]
        else:
            shutil.rmtree(folder, ignore_errors=True)
            rest += ["--out", str(folder / "table.json" if module in ONE_FILE else folder)]
            (folder if module in ONE_FILE else folder.parent).mkdir(parents=True, exist_ok=True)
        command = [*called(module).split(), *rest]
        terminal.say(f"{name}: {' '.join(command)}", style="bold")
        entry: dict[str, Any] = {"command": " ".join(command), "commit": commit()}
        ended = timed(command, lock)
        if folder.exists():
            storage.write_json(folder / LOG, [*log, entry | ended])
        if ended["interrupted"] or ended["exit"] == 130:
            raise KeyboardInterrupt(name)
        if ended["exit"] != 0:
            self._failed[name] = f"{entry['command']}: exit status {ended['exit']}"
            raise RunError(self._failed[name])


def finished(folder: Path) -> bool:
    """A run is: its last process ended well, or there is nothing left in it to resume.

    It may have been resumed by itself, of which its log does not tell.
    """
    well = (folder / LOG).exists() and read(folder / LOG)[-1]["exit"] == 0
    return well or (_begun(folder) and not resumable(folder))


def resumable(folder: Path) -> bool:
    """There is a run in the folder that `--resume` goes on with."""
    return _begun(folder) and (folder / record.CHECKPOINTS).is_dir()


def called(module: str) -> str:
    """How an experiment is called, which is its name in config.json."""
    return f"python -m experiments.{module}"


def goes_on(folder: Path, module: str) -> bool:
    """Whether the experiment would go on with the run here; says why not."""
    argv = ["--resume", str(folder)]
    try:
        experiment.interrupted(folder, called(module), None, argv)
    except ValueError as error:
        terminal.say(f"{error}; it begins anew", style="yellow")
        return False
    return True


def _begun(folder: Path) -> bool:
    """By an experiment that keeps checkpoints until it is finished."""
    return (folder / "config.json").exists() and "experiment" in read(folder / "config.json")


def timed(command: list[str], lock: int) -> dict[str, Any]:
    """Runs a command to its end, also after Ctrl-C, which reaches it too.

    Args:
        command: its first word stands for this interpreter.
        lock: descriptor that the process inherits.

    Returns:
        Exit status, whether there was a Ctrl-C, wall and CPU seconds.
    """
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    interrupted = False
    with subprocess.Popen([sys.executable, *command[1:]], pass_fds=(lock,)) as process:
        try:
            while process.returncode is None:
                try:
                    process.wait()
                except KeyboardInterrupt:
                    interrupted = True  # it writes a checkpoint first
        finally:
            if process.returncode is None:
                process.terminate()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "exit": process.returncode,
        "interrupted": interrupted,
        "seconds": time.perf_counter() - began,
        "cpu_seconds": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
    }


def commit() -> str:
    """Returns the commit of the code that runs, with a + if files differ; "" without git."""
    try:
        here = Path(__file__).parent
        git = lambda *words: subprocess.run(  # noqa: E731
            ["git", *words], cwd=here, capture_output=True, text=True, check=True
        ).stdout.strip()
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "--short=10", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return ""
