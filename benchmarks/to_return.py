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

import jax
import numpy as np
import tyro

from benchmarks.report import machine
from experiments.paper import published
from experiments.paper.scores import RP
from experiments.paper.section import HALF_A_DIGIT
from experiments.tasks import EXPERIMENTS
from rp_jax import storage
from rp_jax.cli import errors, experiment, terminal
from rp_jax.cli.experiment import Run
from rp_jax.runs import tables, train
from rp_jax.runs.evaluate import evaluate
from rp_jax.runs.plan import plan
from rp_jax.runs.progress import OnProgress
from rp_jax.runs.train import Process
from rp_jax.threat.function import ThreatFunction
from rp_jax.validate import number, one_of


@dataclass(frozen=True)
class Config:
    """Settings of the trial."""

    env: str = "circuit"  # or jam
    baseline: str = "paper"  # or plans
    threat: Path | None = None  # folder of a threat function to use
    budgets: tuple[int, ...] = (100_000, 150_000, 200_000, 300_000, 400_000)  # agent steps
    num_envs: int = 32  # side by side; the fewer, the more often a step is learned from
    batch: int = 128  # transitions replayed at once
    seeds: int = 3  # runs for each, one after another
    episodes: int = 1000  # evaluated each
    out: Path | None = None  # JSON file


def prepared(config: Config) -> Run:
    """Returns what is learned, checked: the task with the variant that is learned on alone.

    Raises:
        ValueError: a setting is out of range, or a file cannot be used.
    """
    module = EXPERIMENTS[one_of("env", config.env, published.SCORES)]
    number("seeds", config.seeds, least=1, integer=True)
    quick = module.quick("tuned")
    settings = dataclasses.replace(
        quick,
        planning=dataclasses.replace(quick.planning, num_envs=config.num_envs, batch=config.batch),
        baseline=config.baseline,
        episodes=config.episodes,
    )
    if not config.budgets:
        raise ValueError("budgets is (); it must have at least one value")
    for budget in config.budgets:
        dataclasses.replace(settings.planning, steps=budget).validate("budgets")
    variant, world = published.LEARNED_ON[config.env], module.make_world(settings)
    world = world._replace(tests={variant: world.tests[variant]})
    threats = experiment.threats_of(settings)
    process = Process(threat=config.threat, figures=False)
    train.checked(world, settings, threats, process)
    return Run(world, settings, threats, process, Path())


def learned(
    run: Run, threat: ThreatFunction | None, budget: int, seed: int, bar: OnProgress
) -> dict[str, Any]:
    """Learns with a budget of steps, and evaluates: a row, with the seconds of learning."""
    key, world, config = jax.random.key(0), run.world, run.config
    (variant,) = world.tests
    agents = plan(
        key,
        world.env,
        world.params(),
        threat,
        x=config.x,
        seeds=[seed],
        config=dataclasses.replace(config.planning, steps=budget),
        on_progress=bar,
    )
    (row,) = evaluate(
        key,
        agents,
        params=world.params(variant),
        episodes=config.episodes,
        penalty=config.penalty,
        name=variant,
        on_progress=bar,
    )
    took = {
        "seconds": agents.seconds["planning"],
        "compile_seconds": agents.seconds["planning_compilation"],
    }
    return {"budget": budget, **took, **row}


def measured(config: Config, run: Run) -> dict[str, Any]:
    """Returns a row per budget and seed, and the seconds of the threat function."""
    key = jax.random.key(0)
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        with terminal.progress() as bar:
            threat = train.threat_of(
                key, run.world, run.config, run.threats, Path(folder), run.process, bar
            )
        explored = time.perf_counter() - began if config.threat is None else None
        rows = []
        for budget in config.budgets:
            for seed in range(config.seeds):
                with terminal.progress(f"{budget:,} steps, seed {seed}") as bar:
                    rows.append(learned(run, threat, budget, seed, bar))
    return {"machine": machine(), "threat_seconds": explored, "rows": rows}


def show(found: dict[str, Any], env: str) -> None:
    """Prints a line per budget, and the first of them that all seeds pass with."""
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
    terminal.table(title, lines, list(lines[0]))
    terminal.say(f"all seeds past it: {passed[0] if passed else 'with none of these budgets'}")
    if found["threat_seconds"] is not None:
        terminal.say(f"threat function: {found['threat_seconds']:.1f} s, compilation included")


def main() -> None:
    """Runs the command; exits with 2 on bad input."""
    config = tyro.cli(Config, prog="python -m benchmarks.to_return", description=__doc__)
    with errors.bad_input():
        run = prepared(config)
        errors.needs_folder(config.out)
    found = measured(config, run)
    show(found, config.env)
    if config.out is not None:
        storage.write_json(config.out, found)


if __name__ == "__main__":
    main()
