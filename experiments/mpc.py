"""MPC (appendix G.4; tables 1 and 2): tree search in the true model, on each variant of a task.

python -m experiments.mpc --env jam --horizon 3 --variants N=8
"""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import rp_jax
from experiments import cli, console, evaluation, pipeline, tables, tasks
from experiments.runs import EXPERIMENTS
from rp_jax import evaluate, storage
from rp_jax.baselines import mpc
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
    key: jax.Array, search: mpc.Search, episodes: int, bar: console.Bar
) -> tuple[evaluate.Episodes, float]:
    """All episodes, a group after another, and the seconds it took without compilation."""
    pmdp = mpc.omniscient(search)
    size = min(GROUP, episodes)

    def group(key: jax.Array, pmdp: mpc.Omniscient, search: mpc.Search) -> evaluate.Episodes:
        return evaluate.run_episodes(key, pmdp, mpc.policy(search), size, batch=size)

    bar("", 0, episodes, "compiling")
    run = jax.jit(group).lower(key, pmdp, search).compile()
    parts: list[evaluate.Episodes] = []
    began = time.perf_counter()
    for i in range(-(-episodes // size)):
        found = run(jax.random.fold_in(key, i), pmdp, search)
        parts.append(jax.tree.map(np.asarray, found))
        crashes = sum(int((part.danger > 0).sum()) for part in parts)
        done = min((i + 1) * size, episodes)
        bar("", done, episodes, f"{crashes} crashes in {(i + 1) * size}")
    seconds = time.perf_counter() - began
    return jax.tree.map(lambda *a: np.concatenate(a), *parts), seconds


def action_seconds(key: jax.Array, search: mpc.Search) -> tuple[float, float]:
    """(wall, CPU) time of 100 decisions."""
    act = jax.jit(lambda state, search: jnp.argmax(mpc.pruned(state, search)))
    env: Any = search.model
    return evaluation.action_seconds(key, env, search.params, lambda state: act(state, search))


def run(
    config: Config, task: tasks.Task, searches: list[mpc.Search], penalty: float
) -> list[dict[str, Any]]:
    """One row per variant."""
    rows = []
    name = f"MPC ({config.horizon} steps)"
    key = tasks.key_of(config.seed, tasks.EVALUATION)
    for variant, search in zip(task.tests, searches, strict=True):
        with console.progress(f"{name}, {variant}") as bar:
            episodes, seconds = play(key, search, config.episodes, bar)
        played = int(episodes.length.sum())
        wall, cpu = action_seconds(key, search)
        kept = jax.tree.map(lambda a: a[: config.episodes], episodes)
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
    """The command line."""
    config = tyro.cli(Config, prog="python -m experiments.mpc", description=__doc__)
    with cli.bad_input():
        task, searches, penalty = prepare(config)
        out = config.out or pipeline.default_out(f"mpc-{config.env}", str(config.horizon))
        folder = storage.new_folder(out)
    versions = {"rp_jax": rp_jax.__version__, "jax": jax.__version__}
    settings = {**dataclasses.asdict(config), "penalty": penalty, "versions": versions}
    storage.write_json(folder / "config.json", settings)
    rows = run(config, task, searches, penalty)
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
