"""Runs killed with SIGKILL at random moments, resumed, and compared with one left alone.

python tests/experiments/killed.py --kills 1000 --out killed.json

One process imports everything and never computes; every run is a fork of it.
"""

import argparse
import contextlib
import gc
import itertools
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

TESTS = Path(__file__).parents[1]
THREADS = Path("/proc/self/task")  # where the system has it
TIMES = {"seconds", "seconds_per_100_actions", "train_seconds"}
LOOPS = ("threat pit labels", "threat pit fit", "threat pit report", "sums pit", "planning")
LOOPS += ("evaluation",)
OPERATIONS = ("fsync", "replace", "unlink", "rmdir", "chmod", "mkdir")
LEAST = 8  # operations on files at each step of a loop

# Runs and the phases they are killed in, "write" at an operation on a file, "moment" at any time.
WHOLE = [("beginning", "write"), *itertools.product(LOOPS[:4], ("write", "moment"))]
REUSED = [("planning", "write"), ("planning", "moment")] * 2  # with a threat function at hand
REUSED += [("evaluation", "write"), ("evaluation", "moment"), ("end", "write")]
ANYWHERE = [("", "write")] * 4
COVER = [("whole", WHOLE), ("reused", REUSED)] * 2 + [("whole", ANYWHERE)]


def corridor():
    """The corridor as an experiment of seconds: its presets, and how its task is made."""
    import probe

    from experiments import pipeline
    from rp_jax.planning.loop import LoopConfig
    from rp_jax.threat.build import ThreatConfig
    from rp_jax.threat.fit import FitConfig

    fit = FitConfig(hidden=(8,), steps=40, batch=32)
    threat = ThreatConfig(states=30_000, test_states=100, fit=fit)
    planning = LoopConfig(steps=800, num_envs=16, batch=32, n_step=2, replay=512, replay_start=64)

    @dataclass(frozen=True)
    class Config(pipeline.Config):
        pit: ThreatConfig = field(default_factory=lambda: threat)

    def make_task(config):
        tests = {f"slip {slip:g}": probe.make_params(slip=slip) for slip in (0.1, 0.3)}
        train = probe.make_params()
        return pipeline.Task("corridor", probe, train, tests, {"pit": config.pit}, None)

    def preset(recipe):
        return Config(x=0.5, episodes=64, planning=planning, figures=False)

    return {"quick": preset}, make_task


class Target(NamedTuple):
    """Where a run dies by its own hand: at an operation on a file, counted in each phase."""

    phase: str  # "" counts from the beginning of the process
    operation: int


def worker(argv, target, tell):
    """A run of the corridor in this process; `tell` gets a line for each phase that begins."""
    import jax
    from quick import unoptimised

    from experiments import cli
    from rp_jax import checkpoints
    from rp_jax.checkpoints import Checkpoints

    presets, make_task = corridor()
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
        cli.main("killed", __doc__, presets, make_task, list(map(str, argv)))
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


def done(folder, loop):
    """Steps of a loop that a run's checkpoints hold."""
    steps = (folder / "checkpoints").joinpath(*loop.split()).glob("[0-9]*")
    return max((int(path.name) for path in steps), default=0)


class Reference(NamedTuple):
    """A run that was left alone."""

    arguments: list  # more of them, of every such run
    wanted: dict  # its outcome
    lengths: dict  # steps, by phase
    seconds: dict  # by phase
    operations: dict  # by phase, "" for all


def left_alone(folder, arguments=()):
    """Runs once."""
    said = folder.with_suffix(".txt")
    ended = wait(*begin(["--out", folder, *arguments], said), said)
    assert ended.code == 0, ended.said
    *phases, operations = ended.told
    ends = [began for _, _, began in phases[1:]] + [time.monotonic()]
    seconds = {name: end - began for (name, _, began), end in zip(phases, ends, strict=True)}
    lengths = {name: length for name, length, _ in phases}
    return Reference(list(arguments), outcome(folder), lengths, seconds, operations)


def chosen(dice, reference, run, phase, kind):
    """A `Target` or a moment inside a phase; None where the run is past it."""
    left = reference.lengths.get(phase, 1) - (done(run, phase) if phase in LOOPS else 0)
    if left < 1:
        return None
    if kind == "moment":
        return phase, dice.uniform(0, reference.seconds[phase])
    if phase in LOOPS:
        return Target(phase, dice.randint(1, LEAST * left))
    return Target(phase, dice.randint(1, reference.operations[phase]))


def refused_beside(run, said):
    """A second process is told that one is at work on the run."""
    ended = wait(*begin(["--resume", run], said), said)
    assert ended.code == 2, ended.said
    assert "another process is at work in this folder" in " ".join(ended.said.split())


def arguments_of(run, reference):
    """Of the run's next process."""
    if (run / "config.json").exists():
        return ["--resume", run]
    shutil.rmtree(run, ignore_errors=True)  # killed before it had begun
    return ["--out", run, *reference.arguments]


def one_run(dice, reference, targets, run, hit):
    """A run that is killed at each of its targets, and then goes on to its end."""
    said, beside = run.with_suffix(".txt"), lambda: refused_beside(run, run.with_suffix(".beside"))
    for phase, kind in targets:
        at = chosen(dice, reference, run, phase, kind)
        if at is None:
            continue
        arguments = arguments_of(run, reference)
        if isinstance(at, Target):
            ended = wait(*begin(arguments, said, at), said)
        else:
            ended = wait(*begin(arguments, said), said, at, beside)
            beside = None  # once a run
        if ended.code != -signal.SIGKILL:
            assert ended.code == 0 or "it is finished" in ended.said, ended.said
            break
        hit(f"{ended.phase}{', at a write' if isinstance(at, Target) else ''}")
    else:
        ended = wait(*begin(arguments_of(run, reference), said), said)
        finished = ended.code == 2 and "it is finished" in ended.said  # killed while tidying up
        assert ended.code == 0 or finished, ended.said
    found = outcome(run)
    assert found.keys() == reference.wanted.keys(), found.keys() ^ reference.wanted.keys()
    for name, value in reference.wanted.items():
        assert found[name] == value, f"{run}: {name} differs"
    shutil.rmtree(run)


def lane(number, lanes, kills, seed, references, folder, log):
    """Its share of the kills, one after another; a line of the log for each kill and each run."""
    dice = random.Random(f"{seed} {number}")
    hits = 0

    def hit(where):
        nonlocal hits
        hits += 1
        os.write(log, (json.dumps({"hit": where}) + "\n").encode())

    for i in itertools.count():
        if hits >= kills:
            return
        name, targets = COVER[(i + number) % len(COVER)]
        run = folder / f"{number}-{i}"
        one_run(dice, references[name], targets[: kills - hits], run, hit)
        os.write(log, b'{"finished": 1}\n')


def summary(log, facts, began):
    """The log, counted."""
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    hits = Counter(line["hit"] for line in lines if "hit" in line)
    finished = sum(line.get("finished", 0) for line in lines)
    found = {**facts, "kills": sum(hits.values()), "runs_to_the_same_bits": finished}
    return {**found, "hits": dict(sorted(hits.items())), "seconds": time.monotonic() - began}


def campaign(kills, seed, lanes, folder, out=None):
    """Kills runs until `kills` are reached, in as many lanes; returns what `summary` does.

    Raises:
        AssertionError: a resumed run came to anything else than the one left alone.
    """
    from rp_jax import storage

    began = time.monotonic()
    left_alone(folder / "first")  # compiles
    whole = left_alone(folder / "alone")
    assert whole.wanted == outcome(folder / "first")
    reused = ["--threat", folder / "alone" / "threat"]
    references = {"whole": whole, "reused": left_alone(folder / "reused", reused)}
    log = folder / "log.jsonl"
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    pids = []
    for number in range(lanes):
        pids.append(os.fork())
        if not pids[-1]:
            code = 1
            try:
                share = kills // lanes + (number < kills % lanes)
                lane(number, lanes, share, seed, references, folder, file)
                code = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
    facts = {"wanted": kills, "seed": seed, "lanes": lanes, "differing": 0}
    while pids:
        pid, status = os.waitpid(-1, os.WNOHANG)
        if pid:
            pids.remove(pid)
            facts["differing"] += status != 0
        time.sleep(1)
        if out:
            storage.write_json(out, summary(log, facts, began))
    found = {**summary(log, facts, began), "cpu_seconds": sum(os.times()[:4])}
    if out:
        storage.write_json(out, found)
    return found


def main():
    """Exits with 1 if a run came to other bits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lanes", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    # One thread: that of whatever is imported here has to be none.
    os.environ.update(OPENBLAS_NUM_THREADS="1", COLUMNS="200")
    sys.path[:0] = [str(TESTS.parent), str(TESTS)]
    import jax
    import quick  # noqa: F401

    from experiments import cli  # noqa: F401

    corridor()
    folder = Path(tempfile.mkdtemp())
    cache = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(folder / "cache"))
    jax.config.update("jax_compilation_cache_dir", cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    found = campaign(given.kills, given.seed, given.lanes, folder, given.out)
    print(json.dumps(found))
    if found["differing"]:
        raise SystemExit(f"{folder} holds what differs")
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()
