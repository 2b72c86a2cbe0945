"""Runs of the corridor in forks of a process that has imported everything and never computes."""

import contextlib
import gc
import json
import os
import signal
import sys
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

THREADS = Path("/proc/self/task")  # where the system has it
TIMES = {"seconds", "seconds_per_100_actions", "train_seconds", "resumed"}
LOOPS = ("threat pit labels", "threat pit fit", "threat pit report", "threat sum pit", "plan")
LOOPS += ("evaluation slip 0.1", "evaluation slip 0.3")
OPERATIONS = ("fsync", "replace", "unlink", "rmdir", "chmod", "mkdir")


def corridor(name="killed"):
    """The corridor as an experiment of seconds."""
    import probe

    from rp_jax.cli.experiment import Experiment
    from rp_jax.planning.loop import LoopConfig
    from rp_jax.runs.train import TrainConfig, World
    from rp_jax.threat.build import ThreatConfig
    from rp_jax.threat.fit import FitConfig

    fit = FitConfig(hidden=(8,), steps=40, batch=32)
    sizes = {"states": 30_000, "sampling": "uniform", "miss_rate": 1.0, "test_states": 100}
    threat = ThreatConfig(**sizes, fit=fit)
    planning = LoopConfig(steps=800, num_envs=16, batch=32, n_step=2, replay=512, replay_start=64)

    @dataclass(frozen=True)
    class Config(TrainConfig):
        x: float = 0.5
        episodes: int = 64
        planning: LoopConfig = field(default_factory=lambda: planning)
        pit: ThreatConfig = field(default_factory=lambda: threat)

    def make_world(config):
        tests = {f"slip {slip:g}": {"slip": slip} for slip in (0.1, 0.3)}
        return World("corridor", probe, {}, tests)

    return Experiment(name, __doc__, {"quick": lambda recipe: Config()}, make_world)


class Target(NamedTuple):
    """Where a run dies by its own hand: at an operation on a file, counted in each phase."""

    phase: str  # "" counts from the beginning of the process
    operation: int


def worker(argv, target, tell):
    """A run of the corridor in this process; `tell` gets a line for each phase that begins."""
    import jax
    from quick import unoptimised

    from rp_jax import checkpoints
    from rp_jax.checkpoints import Checkpoints
    from rp_jax.cli import experiment

    checkpoints.INTERVAL, checkpoints.SHARE = 0.0, float("inf")
    phase, counts = "", Counter()

    def enter(name, length=1):
        nonlocal phase
        phase = name
        os.write(tell, (json.dumps([name, length, time.monotonic()]) + "\n").encode())

    def counted(operation):
        def call(*args, **kwargs):
            for place in (phase, ""):
                counts[place] += 1
                if target == (place, counts[place]):
                    os.kill(os.getpid(), signal.SIGKILL)
            return operation(*args, **kwargs)

        return call

    def looped(self, state, step, length, *result):
        enter(self.name, length)
        found = loop(self, state, step, length, *result)
        if self.name == LOOPS[-1]:
            enter("end")
        return found

    loop, Checkpoints.loop = Checkpoints.loop, looped
    for name in OPERATIONS:
        setattr(os, name, counted(getattr(os, name)))
    enter("beginning")
    with unoptimised(), jax.numpy_rank_promotion("allow"):
        words = list(map(str, argv))
        experiment.run(corridor(), words + ["--no-figures"] * ("--out" in words))
    os.write(tell, (json.dumps(counts) + "\n").encode())


def begin(argv, said, target=None):
    """Forks a worker; its process id, and the lines that it tells."""
    if THREADS.exists():
        assert len(list(THREADS.iterdir())) == 1, "a fork takes one thread along"
    listen, tell = os.pipe()
    pid = os.fork()
    if pid:
        os.close(tell)
        return pid, os.fdopen(listen)
    code = 1
    try:
        gc.disable()
        os.close(listen)
        file = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, 1)
        os.dup2(file, 2)
        worker(argv, target, tell)
        code = 0
    except SystemExit as stop:
        code = stop.code
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


class Ended(NamedTuple):
    """How a worker ended."""

    code: int  # below 0: the signal that killed it
    said: str
    told: list  # [phase, length, time], and at the end its operations on files by phase

    @property
    def phase(self):
        """The last one that began."""
        return self.told[-1][0] if self.told else "beginning"


def wait(pid, lines, said, moment=None, beside=None):
    """Waits for a worker; with a `moment`, (phase, seconds), kills it that long after.

    `beside` is called while the worker stands still at the beginning of that phase.
    """
    told = []
    for line in lines:
        told.append(json.loads(line))
        if moment and told[-1][0] == moment[0]:
            if beside:
                os.kill(pid, signal.SIGSTOP)
                beside()
                os.kill(pid, signal.SIGCONT)
            time.sleep(moment[1])
            os.kill(pid, signal.SIGKILL)
            moment = None
    lines.close()
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    return Ended(code, said.read_text(errors="replace"), told)


def timeless(value):
    """JSON without what is measured by a clock."""
    if isinstance(value, dict):
        return {k: timeless(v) for k, v in value.items() if k not in TIMES}
    return [timeless(v) for v in value] if isinstance(value, list) else value


def outcome(folder):
    """All files of a finished run, times left out."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.suffix == ".json" and name != "config.json":
            found[name] = timeless(json.loads(path.read_text()))
            found[name].pop("seal", None) if isinstance(found[name], dict) else None
        elif path.suffix == ".jsonl":
            found[name] = [timeless(json.loads(line)) for line in path.read_text().splitlines()]
        elif path.is_file():
            found[name] = path.read_bytes() if path.suffix == ".bin" else None
    return found
