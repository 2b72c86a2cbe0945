"""Loops that go on where they were interrupted, to the same bits."""

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
LAST = 2  # checkpoints of a loop that are kept
INTERVAL = 60.0  # seconds between two checkpoints of a loop, at least
SHARE = 0.01  # of a loop's time that goes into checkpoints, at most


def chunks_of(units: int, most: int) -> tuple[int, int]:
    """(chunks, units of each): at most so many, all alike, of at least `units` together."""
    length = -(-units // most)
    return -(-units // length), length


@dataclass(frozen=True)
class Checkpoints:
    """A folder with the checkpoints of one loop, or with such folders; or none."""

    folder: Path | None
    run: str = ""  # checksum of the settings that the checkpoints hold for
    name: str = ""  # of the loop, for messages
    say: Callable[[str], None] = print

    def at(self, name: str) -> "Checkpoints":
        """Those of one part of a job."""
        if self.folder is None:
            return self
        return replace(self, folder=self.folder / name, name=f"{self.name} {name}".strip())

    def begun(self) -> bool:
        """Whether there is any checkpoint in the folder, or in a folder of it."""
        return self.folder is not None and any(_by_age(p) for p in self.folder.glob("**/"))

    def loop(
        self,
        state: State,
        step: Callable[[int, State], State],
        length: int,
        result: Callable[[State], Any] = lambda state: state,
    ) -> Any:
        """`result` of the state after `step(i, state)` for i from 0 to `length` - 1.

        Steps that a checkpoint already holds are not repeated. A checkpoint is written between
        steps, every `INTERVAL` seconds or less often; of the end, `result` alone is kept. On
        Ctrl-C the step is finished first and a checkpoint written.

        Args:
            state: a pytree of arrays and keys, the same in every process.
            step: may change the state in place.
            length: number of steps.
            result: picks a part of a state; nothing is computed.

        Raises:
            KeyboardInterrupt: with what is done, for the user.
            storage.StorageError: a checkpoint cannot be written (the older ones are whole), or is
                of a run with other settings.
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
        """Removes all of them: the job is done."""
        if self.folder is not None:
            shutil.rmtree(self.folder)

    def _save(self, done: int, length: int, state: Any) -> None:
        assert self.folder is not None
        about = {"run": self.run, "loop": self.name, "done": done, "of": length}
        storage.save(self.folder / f"{done:08d}", KIND, state, about)
        for old in _by_age(self.folder)[LAST:]:
            shutil.rmtree(old, ignore_errors=True)

    def _newest(self, state: Any, length: int, result: Callable[[Any], Any]) -> tuple[int, Any]:
        """(steps done, the state or at the end the result) of the newest whole checkpoint."""
        assert self.folder is not None
        for path in _by_age(self.folder):
            try:
                about = storage.read_manifest(path, KIND)["about"]
                ours = (about.get("run"), about.get("of")) == (self.run, length)
                done = int(path.name)
                like = result(state) if done == length else state
                found = storage.load(path, KIND, like) if ours else None
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
    """The newest first."""
    return sorted((p for p in folder.glob("*") if p.name.isdecimal()), reverse=True)


@contextmanager
def _deferred_interrupt(say: Callable[[str], None]) -> Iterator[Callable[[], bool]]:
    """Asks whether Ctrl-C was pressed. The first one waits, the second one is as usual."""
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
