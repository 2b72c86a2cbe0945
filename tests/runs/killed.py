"""Runs killed with SIGKILL at random moments, resumed, and compared with one left alone.

python tests/runs/killed.py --kills 1000 --out killed.json

One process imports everything and never computes; every run is a fork of it.
"""

import argparse
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
from pathlib import Path
from typing import NamedTuple

from forked import LOOPS, Target, begin, corridor, outcome, wait

TESTS = Path(__file__).parents[1]
LEAST = 8  # operations on files at each step of a loop

# Runs and the phases they are killed in, "write" at an operation on a file, "moment" at any time.
WHOLE = [("beginning", "write"), *itertools.product(LOOPS[:4], ("write", "moment"))]
REUSED = [("plan", "write"), ("plan", "moment")] * 2  # with a threat function at hand
REUSED += [*itertools.product(LOOPS[5:], ("write", "moment")), ("end", "write")]
ANYWHERE = [("", "write")] * 4
COVER = [("whole", WHOLE), ("reused", REUSED)] * 2 + [("whole", ANYWHERE)]


def done(folder, loop):
    """Steps of a loop that a run's checkpoints hold."""
    places = {  # of jobs that have a folder, or parts, of their own
        "threat pit labels": "threat/checkpoints/threat/pit/labels",
        "threat pit fit": "threat/checkpoints/threat/pit/fit",
        "threat pit report": "threat/checkpoints/threat/pit/report",
        "threat sum pit": "threat/checkpoints/threat/sum pit",
    }
    steps = (folder / places.get(loop, f"checkpoints/{loop}")).glob("[0-9]*")
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

    from rp_jax.cli import experiment  # noqa: F401
    from rp_jax.runs import train  # noqa: F401

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
