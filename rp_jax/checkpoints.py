"""Loops that continue where they were interrupted, with bit-identical results."""

import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from rp_jax import storage

State = TypeVar("State")

KIND = "checkpoint"
LAST = 2  # how many checkpoints of a loop are kept
INTERVAL = 60.0  # seconds between two checkpoints of a loop, at least
SHARE = 0.01  # greatest share of a loop's time that may go into writing checkpoints


def equal_chunks(units: int, most: int) -> tuple[int, int]:
    """Returns how to divide work into chunks of equal size.

    Args:
        units: number of units of work.
        most: greatest allowed number of chunks.

    Returns:
        (chunks, length): the number of chunks, and the number of units in each; together they hold
        at least `units`.
    """
    length = -(-units // most)
    return -(-units // length), length


@dataclass(frozen=True)
class Checkpoints:
    """A folder that holds the checkpoints of a loop, or of several loops in subfolders; or none."""

    folder: Path | None  # None: no checkpoints are written or read
    run: str = ""  # checksum of the settings; a checkpoint with another one is refused
    name: str = ""  # the loop's name, for messages
    say: Callable[[str], None] = print  # receives messages for the user

    def at(self, name: str) -> "Checkpoints":
        """Returns the checkpoints of one part of the work, in a subfolder.

        Args:
            name: the part's name, from which the subfolder has its own (`storage.file_name`).
        """
        if self.folder is None:
            return self
        folder = self.folder / storage.file_name(name)
        return replace(self, folder=folder, name=f"{self.name} {name}".strip())

    def begun(self) -> bool:
        """Returns whether there is a checkpoint in the folder or in any of its subfolders."""
        return self.folder is not None and any(_by_age(p) for p in self.folder.glob("**/"))

    def loop(
        self,
        state: State,
        step: Callable[[int, State], State],
        length: int,
        result: Callable[[State], Any] = lambda state: state,
    ) -> Any:
        """Runs a loop, skipping the steps that a checkpoint already holds.

        A checkpoint is written between steps, every `INTERVAL` seconds or less often; the last one
        holds only `result` of the final state. On Ctrl-C the current step is finished and a
        checkpoint is written; a second Ctrl-C stops at once.

        Args:
            state: the state before the first step, a pytree of arrays and keys; it must be the same
                in every process that continues the loop.
            step: maps the step's number, from 0 to `length` - 1, and a state to the next state; it
                may change the state in place.
            length: number of steps.
            result: picks the part of a state that is returned; it must not compute anything.

        Returns:
            `result` of the state after the last step.

        Raises:
            KeyboardInterrupt: the user pressed Ctrl-C; the message says how many steps are done.
            storage.StorageError: a checkpoint cannot be written (older ones are still valid), or
                was written by a run with other settings, or in another precision.
        """
        if self.folder is None:
            for i in range(length):
                state = step(i, state)
            return result(state)
        done, state = self._newest(state, length, result)
        if done == length:
            return state
        due = time.monotonic() + INTERVAL
        with _deferred_interrupt(self.say) as interrupted:
            for i in range(done, length):
                state = step(i, state)
                last = i + 1 == length
                if last or interrupted() or time.monotonic() > due:
                    began = time.monotonic()
                    self._save(i + 1, length, result(state) if last else state)
                    ended = time.monotonic()
                    due = ended + max(INTERVAL, (ended - began) / SHARE)
                if interrupted():
                    raise KeyboardInterrupt(f"{self.name}: {i + 1} of {length} done")
        return result(state)

    def clear(self) -> None:
        """Removes all checkpoints, once the work is done."""
        if self.folder is not None:
            shutil.rmtree(self.folder)

    def _save(self, done: int, length: int, state: Any) -> None:
        """Writes a checkpoint and removes all but the newest ones."""
        assert self.folder is not None
        about = {"run": self.run, "loop": self.name, "done": done, "of": length}
        storage.save(self.folder / f"{done:08d}", KIND, state, about)
        for old in _by_age(self.folder)[LAST:]:
            shutil.rmtree(old, ignore_errors=True)

    def _newest(self, state: Any, length: int, result: Callable[[Any], Any]) -> tuple[int, Any]:
        """Returns the newest checkpoint that is not damaged.

        Returns:
            (steps done, state); after the last step the result in place of the state, and without
            any checkpoint (0, the given state).
        """
        assert self.folder is not None
        for path in _by_age(self.folder):
            try:
                about = storage.read_manifest(path, KIND)["about"]
                ours = (about.get("run"), about.get("of")) == (self.run, length)
                done = int(path.name)
                like = result(state) if done == length else state
                found = storage.load(path, KIND, like) if ours else None
            except storage.PrecisionError as error:  # the work is not lost: it is not begun anew
                raise storage.PrecisionError(f"{error}; go on with that setting") from error
            except storage.StorageError as error:
                self.say(f"warning: {error}; going back to what is older")
                continue
            if not ours:
                raise storage.StorageError(f"{path}: it is not of a run with these settings")
            self.say(f"{self.name}: {done} of {length} were done")
            return done, found
        return 0, state


NO_CHECKPOINTS = Checkpoints(None)


def _by_age(folder: Path) -> list[Path]:
    """Returns the checkpoints in a folder, the newest first."""
    return sorted((p for p in folder.glob("*") if p.name.isdecimal()), reverse=True)


@contextmanager
def _deferred_interrupt(say: Callable[[str], None]) -> Iterator[Callable[[], bool]]:
    """Holds back the first Ctrl-C; a second one acts as usual.

    Yields:
        A function that returns whether Ctrl-C was pressed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    pressed = threading.Event()
    before = signal.getsignal(signal.SIGINT) or signal.default_int_handler

    def wait(*_: Any) -> None:
        pressed.set()
        signal.signal(signal.SIGINT, before)
        say("interrupted: finishing this step; again stops at once")

    signal.signal(signal.SIGINT, wait)
    try:
        yield pressed.is_set
    finally:
        signal.signal(signal.SIGINT, before)
