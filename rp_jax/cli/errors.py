"""How commands end: messages and exit codes in place of tracebacks."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from rp_jax import storage
from rp_jax.cli.terminal import say
from rp_jax.runs import record
from rp_jax.runs.train import can_draw

TERMINATED = 128 + 15  # exit code that shells give a process which SIGTERM has ended


@contextmanager
def bad_input() -> Iterator[None]:
    """Turns a ValueError into a message and exit code 2; numbers that are not finite, into 1."""
    try:
        yield
    except FloatingPointError as error:
        say(f"error: {error}", style="red")
        raise SystemExit(1) from None
    except ValueError as error:
        say(f"error: {error}", style="red")
        raise SystemExit(2) from None


@contextmanager
def resumable(again: str, folder: Path, finish: Callable[[], None]) -> Iterator[None]:
    """Surrounds a run: says how to go on if it is stopped, and exits with what says why.

    That is 130 after Ctrl-C and 143 after SIGTERM, which ends the run as Ctrl-C does; 1 after an
    error; and 2 if another process is at work on the run.

    Args:
        again: the command that goes on.
        folder: of the run.
        finish: called when the run is finished.
    """
    with ExitStack() as stack:
        with bad_input():
            stack.enter_context(storage.locked(folder / record.CHECKPOINTS, record.LOCK))
        terminated = stack.enter_context(sigterm_as_ctrl_c())
        storage.remove_partial_files(folder)
        try:
            yield
            finish()
        except KeyboardInterrupt as stop:
            what, code = ("terminated", TERMINATED) if terminated() else ("interrupted", 130)
            say(f"{what} ({str(stop) or 'between two steps'}); to go on: {again}", style="yellow")
            raise SystemExit(code) from None
        except (FloatingPointError, OSError, storage.StorageError) as error:
            say(f"error: {error}; to go on: {again}", style="red")
            raise SystemExit(1) from None


@contextmanager
def sigterm_as_ctrl_c() -> Iterator[Callable[[], bool]]:
    """Hands SIGTERM, which schedulers send, on as SIGINT, also in a background job.

    Yields:
        A function that returns whether there was a SIGTERM.
    """
    terminated = threading.Event()

    def interrupt(*_: Any) -> None:
        terminated.set()
        if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as shells start "command &"
            raise KeyboardInterrupt
        signal.raise_signal(signal.SIGINT)

    with on_sigterm(interrupt):
        yield terminated.is_set


@contextmanager
def on_sigterm(handler: Callable[..., Any]) -> Iterator[None]:
    """Handles SIGTERM while the context lasts; then what was there before is put back.

    For command lines alone: a library leaves the handlers of a process as they are. In another
    thread than the main one nothing is done.

    Args:
        handler: as `signal.signal` takes it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)


def needs_matplotlib(figures: bool = True) -> None:
    """Raises ValueError if figures are wanted and cannot be drawn.

    Args:
        figures: whether they are wanted.
    """
    if figures and not can_draw():
        raise ValueError("figures is True; without matplotlib it must be False (--no-figures)")


def without_figures(figures: bool) -> None:
    """Says how to get figures, if none are drawn since matplotlib is missing.

    Args:
        figures: whether they are drawn.
    """
    if not figures and not can_draw():
        say("no figures: matplotlib is not installed (pip install 'rp_jax[plot]')")


def needs_folder(out: Path | None) -> None:
    """Raises ValueError if a file that is written at the end could not be, or is there already.

    Args:
        out: the file; None: nothing is written.
    """
    if out is not None and out.exists():
        raise ValueError(f"out is {out}; it must be a new file, but this exists")
    if out is not None and not out.parent.is_dir():
        raise ValueError(f"out is {out}; its folder must exist")
