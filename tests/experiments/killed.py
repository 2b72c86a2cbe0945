"""Runs killed with SIGKILL at random moments, resumed, and compared with one left alone.

python tests/experiments/killed.py --kills 1000 --seed 0
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

TIMES = {"seconds", "seconds_per_100_actions", "train_seconds"}


def corridor():
    """The corridor as an experiment of seconds: its presets, and how its task is made."""
    import probe

    from experiments import pipeline
    from rp_jax.planning.loop import LoopConfig
    from rp_jax.threat.build import ThreatConfig
    from rp_jax.threat.fit import FitConfig

    fit = FitConfig(hidden=(8,), steps=40, batch=32)
    threat = ThreatConfig(states=30_000, test_states=100, fit=fit)
    planning = LoopConfig(steps=4000, num_envs=16, batch=32, n_step=2, replay=1024, replay_start=64)

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


def worker(argv, kill_at):
    """A run of the corridor in this process; dies at its `kill_at`-th operation on a file."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    import jax
    from quick import unoptimised

    from experiments import cli
    from rp_jax import checkpoints

    presets, make_task = corridor()
    checkpoints.INTERVAL, checkpoints.SHARE = 0.0, float("inf")
    count = 0

    def counted(operation):
        def call(*args, **kwargs):
            nonlocal count
            count += 1
            if count == kill_at:
                os.kill(os.getpid(), signal.SIGKILL)
            return operation(*args, **kwargs)

        return call

    for name in ("fsync", "replace", "unlink", "chmod", "mkdir"):
        setattr(os, name, counted(getattr(os, name)))
    print("ready", flush=True)
    with unoptimised(), jax.numpy_rank_promotion("allow"):
        cli.main("killed", __doc__, presets, make_task, argv)
    print(f"operations {count}", flush=True)


def begin(arguments, cache, kill_at=0):
    """A worker that is ready to begin."""
    command = [sys.executable, __file__, "--worker", str(kill_at), *map(str, arguments)]
    names = {"JAX_COMPILATION_CACHE_DIR": str(cache), "COLUMNS": "200"}
    names["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    process = subprocess.Popen(
        command, env={**os.environ, **names}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    line = process.stdout.readline()
    assert line == b"ready\n", line + process.stdout.read()
    return process


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
        elif path.is_file() and path.suffix == ".bin":
            found[name] = path.read_bytes()
    return found


def stage(folder):
    """Where a killed run had come to."""
    parts = {
        "evaluation": folder / "checkpoints" / "evaluation",
        "planning": folder / "checkpoints" / "planning",
        "sums": folder / "checkpoints" / "sums",
        "fit": folder / "checkpoints" / "threat" / "pit" / "fit",
        "labels": folder / "checkpoints" / "threat",
    }
    return next((name for name, path in parts.items() if path.exists()), "beginning")


def campaign(kills, seed, folder, say=print):
    """Kills runs until `kills` are reached; returns how many in which stage, and runs finished.

    Raises:
        AssertionError: a resumed run came to anything else than the one left alone.
    """
    dice = random.Random(seed)
    cache = folder / "cache"
    begin(["--out", folder / "first"], cache).communicate()  # compiles
    process = begin(["--out", folder / "alone"], cache)
    began = time.monotonic()
    said = process.communicate()[0].decode()
    seconds = time.monotonic() - began
    assert process.returncode == 0, said
    operations = int(said.split()[-1])
    wanted = outcome(folder / "alone")
    assert wanted == outcome(folder / "first")
    say(f"alone: {seconds:.1f} s, {operations} operations on files, {len(wanted)} files")
    hits, finished, run = Counter(), 0, folder / "run-0"
    while sum(hits.values()) < kills or run.exists():
        resumed = (run / "config.json").exists()
        if run.exists() and not resumed:  # killed before it had begun
            run = folder / f"{run.name}-again"
        arguments = ["--resume", run] if resumed else ["--out", run]
        more = sum(hits.values()) < kills
        writes = more and dice.random() < 0.5
        process = begin(arguments, cache, dice.randint(1, operations) if writes else 0)
        if more and not writes:
            try:
                process.wait(dice.uniform(0, seconds))
            except subprocess.TimeoutExpired:
                process.kill()
        said = process.communicate()[0].decode()
        if process.returncode == -signal.SIGKILL:
            hits[f"{stage(run)}{', at a write' if writes else ''}"] += 1
            continue
        if process.returncode == 2 and "it is finished" in said:
            pass  # killed after its last checkpoint was removed
        else:
            assert process.returncode == 0, said
        found = outcome(run)
        assert found.keys() == wanted.keys(), found.keys() ^ wanted.keys()
        for name, value in wanted.items():
            assert found[name] == value, f"{name} differs"
        finished += 1
        run = folder / f"run-{finished}"
        say(f"{sum(hits.values())} kills, {finished} runs came to the same bits; {dict(hits)}")
    return hits, finished


if __name__ == "__main__":
    if sys.argv[1:2] == ["--worker"]:
        worker(sys.argv[3:], int(sys.argv[2]))
    else:
        parser = argparse.ArgumentParser(description=__doc__)
        parser.add_argument("--kills", type=int, default=1000)
        parser.add_argument("--seed", type=int, default=0)
        given = parser.parse_args()
        with tempfile.TemporaryDirectory() as place:
            campaign(given.kills, given.seed, Path(place))
