"""Return and crash rate over the threshold x, from one threat function.

Planners for all x are trained side by side in one program; beside them one planner that is told
x. Neither retrains the threat function.

python -m experiments.frontier --preset quick
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments import cli, console, jam, pipeline, reconnaissance, tables, tasks, training
from rp_jax import storage
from rp_jax.checkpoints import Checkpoints
from rp_jax.planning import conditioned
from rp_jax.validate import number


@dataclass(frozen=True)
class Config(jam.Config):
    """Settings: those of Jam; `x` is where the threat function was looked at closely."""

    thresholds: tuple[float, ...] = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1)

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        super().validate()
        number("x", self.x, most=1)
        if len(self.thresholds) < 2 or list(self.thresholds) != sorted(set(self.thresholds)):
            raise ValueError(f"thresholds is {self.thresholds}; it must ascend, two at least")
        for x in self.thresholds:
            number("thresholds", x, above=0, most=1)


def members_of(config: Config) -> list[training.Member]:
    """One for each threshold and seed."""
    seeds = tasks.members_of(config)
    return [member._replace(x=x) for x in config.thresholds for member in seeds]


def told(
    task: tasks.Task, config: Config, pmdp: Any
) -> tuple[tasks.Task, Any, list[training.Member]]:
    """The task, P-MDP and members of the planner that is told x.

    Its tests are those of the task at each threshold.
    """
    low, high = config.thresholds[0], config.thresholds[-1]
    tests = {
        f"{name} x={x:g}": conditioned.make_params(params, x, x)
        for x in config.thresholds
        for name, params in task.tests.items()
    }
    whole = conditioned.condition(pmdp, low, high)
    members = [member._replace(x=1.0) for member in tasks.members_of(config)]
    return task._replace(env=whole.env, train=whole.params, tests=tests), whole, members


def run(task: tasks.Task, config: Config, folder: Path, checkpoints: Checkpoints) -> None:
    """Trains and evaluates both, into a prepared folder: frontier.json and the figure."""
    models, _, _ = reconnaissance.learn_threats(task, config, folder, checkpoints)
    pmdp, members = tasks.make_pmdp(task, config, models, task.train), members_of(config)
    _, rows = pipeline.plan_and_evaluate(
        task, config, pmdp, members, folder / "separate", checkpoints.at("separate")
    )
    found = [{"planner": "separate", **row} for row in rows]
    task, pmdp, members = told(task, config, pmdp)
    _, rows = pipeline.plan_and_evaluate(
        task, config, pmdp, members, folder / "told", checkpoints.at("told")
    )
    for row in rows:
        variant, x = row["variant"].rsplit(" x=", 1)
        found.append({"planner": "told x", **row, "variant": variant, "x": float(x)})
    found = summarised(found)
    storage.write_json(folder / "frontier.json", found)
    show(found)
    if config.figures:
        from rp_jax.plot import curves

        curves.frontier(found, folder / "frontier.png")
    console.say(f"results: {folder}")


def summarised(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row per planner, variant and threshold, over the seeds."""
    groups: dict[tuple, list] = {}
    for row in rows:
        groups.setdefault((row["planner"], row["variant"], row["x"]), []).append(row)
    found = []
    for (planner, variant, x), group in groups.items():
        (summary,) = tables.over_seeds(group)
        insecure = float(np.mean([row["insecure"] for row in group]))
        found.append(
            {"planner": planner, **summary, "variant": variant, "x": x, "insecure": insecure}
        )
    return found


def show(rows: Sequence[dict[str, Any]]) -> None:
    """One table per variant."""
    for variant in dict.fromkeys(row["variant"] for row in rows):
        lines = [
            {
                "planner": row["planner"],
                "x": f"{row['x']:g}",
                "return": tables.earned(row),
                "crashes": tables.crashed(row),
                "% [95 %]": tables.percent(row),
                "insecure": row["insecure"],
            }
            for row in rows
            if row["variant"] == variant
        ]
        console.table(f"jam {variant}", lines, list(lines[0]))


def quick(recipe: str) -> Config:
    """Minutes on two cores."""
    base = jam.quick(recipe)
    fields = {f.name: getattr(base, f.name) for f in dataclasses.fields(base)}
    return Config(**{**fields, "baseline": "plans", "x": 1e-3, "episodes": 4_000})


def full(recipe: str) -> Config:
    """What committed results are made with."""
    return dataclasses.replace(quick(recipe), seeds=3, episodes=20_000)


PRESETS = {"quick": quick, "full": full}

if __name__ == "__main__":
    cli.main("experiments.frontier", __doc__ or "", PRESETS, jam.make_task, run=run)
