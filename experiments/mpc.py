"""MPC (appendix G.4; tables 1 and 2): tree search in the true model, on each variant of a task.

python -m experiments.mpc --env jam --horizon 3 --variants N=8

--resume DIR, alone, goes on with an interrupted run.
"""

import dataclasses
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments import cli, console, evaluation, pipeline, tables, tasks
from experiments.runs import EXPERIMENTS
from experiments.settings import begin
from rp_jax import evaluate, storage
from rp_jax.baselines import mpc
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.validate import number, one_of

GROUP = 50  # episodes between two reports of progress
AVOIDED = {"point_gather": 200.0}  # what the released search counts a bomb as; it costs 1


@dataclass(frozen=True)
class Config:
    """What is searched, and how often."""

    env: str  # circuit, jam or point_gather
    horizon: int  # steps ahead; the paper: 3, 4, 5 on Circuit, 2, 3 on Jam
    episodes: int = 1000  # per variant
    variants: tuple[str, ...] = ()  # tracks, or N=3, N=8, N=15; none given: all of them
    penalty: float | None = None  # per crash, in search and tables; default: 200 Circuit, 50 Jam;
    # Point Gather: 200 in search, 1 in tables
    limit: float = float("inf")  # danger up to which a sequence is safe; the safe ones come first
    fidelity: str = "released"  # "released" as the published numbers, "paper" as the text
    seed: int = 0
    out: Path | None = None  # folder for results; default: results/mpc-ENV-HORIZON-TIME


def prepare(config: Config) -> tuple[tasks.Task, list[mpc.Search], float]:
    """The task with the variants that are tested, a search for each, and the penalty.

    Raises:
        ValueError: a setting is out of range.
    """
    module = EXPERIMENTS[one_of("env", config.env, EXPERIMENTS)]
    number("episodes", config.episodes, least=1, integer=True)
    number("seed", config.seed, least=0, most=2**31 - 1001, integer=True)
    settings = module.quick("tuned")
    task = module.make_task(dataclasses.replace(settings, fidelity=config.fidelity))
    for variant in config.variants:
        one_of("variants", variant, task.tests)
    tests = {v: task.tests[v] for v in config.variants or task.tests}
    penalty = settings.penalty if config.penalty is None else config.penalty
    avoided = AVOIDED.get(config.env, penalty) if config.penalty is None else penalty
    searches = [
        mpc.make_search(task.env, params, config.horizon, avoided, config.limit)
        for params in tests.values()
    ]
    return task._replace(tests=tests), searches, penalty


def play(
    key: jax.Array,
    search: mpc.Search,
    episodes: int,
    bar: console.Bar,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> tuple[evaluate.Episodes, float]:
    """All episodes, a group after another, and the seconds it took without compilation."""
    pmdp = mpc.omniscient(search)
    size = min(GROUP, episodes)

    def group(key: jax.Array, pmdp: mpc.Omniscient, search: mpc.Search) -> evaluate.Episodes:
        return evaluate.run_episodes(key, pmdp, mpc.values(search), size, batch=size)

    bar("", 0, episodes, "compiling")
    run = jax.jit(group).lower(key, pmdp, search).compile()
    rounds = -(-episodes // size)
    shapes = jax.eval_shape(group, key, pmdp, search)
    rows = jax.tree.map(lambda s: np.zeros((rounds, *s.shape), s.dtype), shapes)

    def step(i: int, carried: tuple[Any, np.ndarray]) -> tuple[Any, np.ndarray]:
        (rows, seconds), began = carried, time.perf_counter()
        found = run(jax.random.fold_in(key, i), pmdp, search)
        for whole, new in zip(jax.tree.leaves(rows), jax.tree.leaves(found), strict=True):
            whole[i] = new
        seconds[i] = time.perf_counter() - began
        crashes, done = int((rows.danger > 0).sum()), min((i + 1) * size, episodes)
        bar("", done, episodes, f"{crashes} crashes in {(i + 1) * size}")
        return rows, seconds

    rows, seconds = checkpoints.loop((rows, np.zeros(rounds, np.float32)), step, rounds)
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), rows), float(seconds.sum())


def action_seconds(key: jax.Array, search: mpc.Search) -> tuple[float, float]:
    """(wall, CPU) time of 100 decisions."""
    act = jax.jit(lambda state, search: jnp.argmax(mpc.pruned(state, search)))
    env: Any = search.model
    return evaluation.action_seconds(key, env, search.params, lambda state: act(state, search))


def run(
    config: Config,
    task: tasks.Task,
    searches: list[mpc.Search],
    penalty: float,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> list[dict[str, Any]]:
    """One row per variant."""
    rows = []
    name = f"MPC ({config.horizon} steps)"
    key = tasks.key_of(config.seed, tasks.EVALUATION)
    for variant, search in zip(task.tests, searches, strict=True):
        with console.progress(f"{name}, {variant}") as bar:
            at = checkpoints.at(variant)
            episodes, seconds = play(key, search, config.episodes, bar, at)
        played = int(episodes.length.sum())
        wall, cpu = action_seconds(key, search)
        kept = jax.tree.map(lambda a: a[: config.episodes], episodes)
        evaluate.check(kept, name)
        rows.append(
            {
                "env": task.name,
                "variant": variant,
                "method": name if np.isinf(config.limit) else f"{name[:-1]}, x={config.limit:g})",
                "seed": config.seed,
                **evaluate.summarise(kept, penalty),
                "seconds_per_100_actions": wall,
                "cpu_seconds_per_100_actions": cpu,
                "seconds_per_100_actions_in_batch": 100 * seconds / played,
                "train_seconds": 0.0,
            }
        )
    return rows


def main() -> None:
    """Exits with 2 on bad input."""
    name, argv = "experiments.mpc", sys.argv[1:]
    folder = cli.to_resume(argv)
    with cli.bad_input():
        if folder is not None:
            config, checkpoints = cli.resumed(name, folder, Config, argv)
            task, searches, penalty = prepare(config)
        else:
            config = tyro.cli(Config, prog=f"python -m {name}", description=__doc__)
            task, searches, penalty = prepare(config)
            out = config.out or pipeline.default_out(f"mpc-{config.env}", str(config.horizon))
            folder = storage.new_folder(out)
            used = {"table": penalty, "search": float(searches[0].penalty)}
            checkpoints = begin(folder, name, dataclasses.asdict(config) | {"penalties": used})
    with cli.resumable(name, folder, checkpoints):
        rows = run(config, task, searches, penalty, checkpoints)
        tables.write(folder, rows)
    for row in rows:
        cpu = row["cpu_seconds_per_100_actions"]
        many = row["seconds_per_100_actions_in_batch"]
        console.say(
            f"{row['variant']}: 100 actions take {cpu:.4f} CPU seconds one after another, "
            f"{many:.4f} seconds among many episodes"
        )
    console.say(f"results: {folder}")


if __name__ == "__main__":
    main()
