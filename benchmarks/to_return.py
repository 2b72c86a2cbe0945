"""Seconds of learning until an agent earns what the paper's does, and crashes no more.

Each budget of steps is a run of its own, whose schedules end with it; compilation and evaluation
do not count. The threat function is that of --threat, or is learned first, and timed too.

python -m benchmarks.to_return --env circuit --baseline plans
python -m benchmarks.to_return --env jam --threat docs/results/jam/threat
"""

import dataclasses
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.report import machine
from experiments import cli, console, pipeline, reconnaissance, tables, tasks
from experiments.paper import published
from experiments.paper.scores import RP
from experiments.paper.section import HALF_A_DIGIT
from experiments.runs import EXPERIMENTS
from rp_jax import storage
from rp_jax.validate import number, one_of


@dataclass(frozen=True)
class Config:
    """What is tried."""

    env: str = "circuit"  # or jam
    baseline: str = "paper"  # or plans
    threat: Path | None = None  # folder of a threat function to use
    budgets: tuple[int, ...] = (100_000, 150_000, 200_000, 300_000, 400_000)  # agent steps
    num_envs: int = 32  # side by side; the fewer, the more often a step is learned from
    batch: int = 128  # transitions replayed at once
    seeds: int = 3  # runs for each, one after another
    episodes: int = 1000  # evaluated each
    out: Path | None = None  # JSON file


def prepare(config: Config) -> tuple[Any, tasks.Task]:
    """The task's own settings, and the task with the variant that is learned on.

    Raises:
        ValueError: a setting is out of range.
    """
    module = EXPERIMENTS[one_of("env", config.env, published.SCORES)]
    number("seeds", config.seeds, least=1, integer=True)
    quick = module.quick("tuned")
    settings = dataclasses.replace(
        quick,
        planning=dataclasses.replace(quick.planning, num_envs=config.num_envs, batch=config.batch),
        baseline=config.baseline,
        threat=config.threat,
        episodes=config.episodes,
        figures=False,
    )
    if not config.budgets:
        raise ValueError("budgets is (); it must have at least one value")
    for budget in config.budgets:
        dataclasses.replace(settings.planning, steps=budget).validate("budgets")
    task = pipeline.checked(module.make_task, settings)
    variant = published.LEARNED_ON[config.env]
    return settings, task._replace(tests={variant: task.tests[variant]})


def run(config: Config, settings: Any, task: tasks.Task) -> dict[str, Any]:
    """A row per budget and seed; seconds of the threat function."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        models, _, _ = reconnaissance.learn_threats(task, settings, Path(folder))
        explored = time.perf_counter() - began if config.threat is None else None
        rows = []
        for budget in config.budgets:
            for seed in range(config.seeds):
                planning = dataclasses.replace(settings.planning, steps=budget)
                own = dataclasses.replace(settings, planning=planning, seed=seed)
                pmdp = tasks.make_pmdp(task, own, models, task.train)
                place = Path(folder) / f"{budget}-{seed}"
                members = tasks.members_of(own)
                trained, (row,) = pipeline.plan_and_evaluate(task, own, pmdp, members, place)
                took = {"seconds": trained.seconds, "compile_seconds": trained.compile_seconds}
                rows.append({"budget": budget, **took, **row})
    return {"machine": machine(), "threat_seconds": explored, "rows": rows}


def show(found: dict[str, Any], env: str) -> None:
    """A line per budget, and the first of them that all seeds pass with."""
    (wanted, rate), lines, passed = published.SCORES[env][published.LEARNED_ON[env]][RP], [], []
    most = rate + HALF_A_DIGIT  # it was rounded
    for budget in dict.fromkeys(row["budget"] for row in found["rows"]):
        rows = [row for row in found["rows"] if row["budget"] == budget]
        (total,) = tables.over_seeds(rows)
        seconds = float(np.median([row["seconds"] for row in rows]))
        past = sum(row["return_mean"] > wanted and row["crash_rate"] < most for row in rows)
        if past == len(rows):
            passed.append(f"{seconds:.1f} s ({budget:,} steps)")
        lines.append(
            {
                "steps": f"{budget:,}",
                "seconds": f"{seconds:.1f}",
                "compiling": f"{np.median([row['compile_seconds'] for row in rows]):.1f}",
                "return": tables.earned(total),
                "crashes": tables.crashed(total),
                "past": f"{past} of {len(rows)}",
            }
        )
    title = f"{env}: past {wanted:g}, and less than {100 * most:g} % crashes"
    console.table(title, lines, list(lines[0]))
    console.say(f"all seeds past it: {passed[0] if passed else 'with none of these budgets'}")
    if found["threat_seconds"] is not None:
        console.say(f"threat function: {found['threat_seconds']:.1f} s, compilation included")


def main() -> None:
    """Exits with 2 on bad input."""
    config = tyro.cli(Config, prog="python -m benchmarks.to_return", description=__doc__)
    with cli.bad_input():
        settings, task = prepare(config)
        cli.needs_folder(config.out)
    found = run(config, settings, task)
    show(found, config.env)
    if config.out is not None:
        storage.write_json(config.out, found)


if __name__ == "__main__":
    main()
