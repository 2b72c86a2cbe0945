"""Return and crash rate over the threshold x, from one threat function.

Agents for all thresholds learn side by side in one program; beside them agents that are told x.
Neither learns the threat function again.

rp-jax frontier --env rp_jax.envs.jam --thresholds .001 .01 .1 --set baseline=plans
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, cast

import jax

from rp_jax import storage
from rp_jax.cli import experiment, terminal, train_command
from rp_jax.cli.experiment import Experiment, Run
from rp_jax.runs import frontier, tables
from rp_jax.runs.progress import OnProgress
from rp_jax.runs.train import World, threat_of
from rp_jax.validate import number, one_of

THRESHOLDS = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1)


def check(config: Any) -> None:
    """Raises ValueError, naming it, if a setting has no place in the comparison.

    To be called before any work, where a run's world is made.

    Args:
        config: with finite thresholds, and a shield.
    """
    number("x", config.x, above=0, most=1)  # the threat function is learned for it
    frontier.check_thresholds(config.thresholds)
    one_of("shield", config.shield, [True])
    one_of("c", config.c, [None])  # the agents go by thresholds


def job(run: Run, bar: OnProgress) -> None:
    """Learns and evaluates for all thresholds; writes frontier.json and the figure.

    Args:
        run: whose configuration has `thresholds`.
        bar: of the progress.
    """
    config: Any = run.config
    check(config)
    key, params = jax.random.key(0), run.world.params()
    threat = threat_of(key, run.world, config, run.threats, run.folder, run.process, bar)
    rows = frontier.frontier(
        key,
        run.world.env,
        params,
        threat,
        thresholds=config.thresholds,
        tests={name: run.world.params(name) for name in run.world.tests},
        seeds=list(range(config.seed, config.seed + config.seeds)),
        config=config.planning,
        lookahead=config.lookahead,
        learning_penalty=config.learning_penalty,
        learning_penalty_from=config.learning_penalty_from,
        insecure_penalty=config.insecure_penalty,
        episodes=config.episodes,
        penalty=config.penalty,
        folder=run.folder,
        devices=run.process.devices,
        on_progress=bar,
    )
    storage.write_json(run.folder / "frontier.json", rows)
    show(run.world.name, rows)
    if run.process.figures:
        from rp_jax.plot import curves

        curves.frontier(rows, run.folder / "frontier.png")


def show(name: str, rows: Sequence[dict[str, Any]]) -> None:
    """Prints one table per test.

    Args:
        name: of the world.
        rows: of `frontier`.
    """
    for variant in dict.fromkeys(row["variant"] for row in rows):
        lines = [
            {
                "planner": row["planner"],
                "x": f"{row['x']:g}",
                "return": tables.earned(row),
                "crashes": tables.crashed(row),
                **tables.rates(row),
                "no admissible action, % of steps": f"{100 * row['insecure']:.3f}",
            }
            for row in rows
            if row["variant"] == variant
        ]
        terminal.table(f"{name} {variant}", lines, list(lines[0]))


def main(argv: Sequence[str]) -> None:
    """Runs the command; exits with 2 on bad input.

    Args:
        argv: arguments after "frontier".
    """
    world, base, rest = train_command.settings_from(argv)
    kind = dataclasses.make_dataclass(
        "Config",
        [("thresholds", tuple[float, ...], dataclasses.field(default=THRESHOLDS))],
        bases=(type(base),),
        frozen=True,
    )

    def checked_world(config: Any) -> World:
        check(config)
        return cast(World, world)

    experiment.run(
        Experiment(
            name="rp-jax frontier",
            about=f"{__doc__}\n{train_command.WORLDS}",
            presets={"default": lambda recipe: kind()},
            make_world=checked_world,
            job=job,
            recipes=("tuned",),
        ),
        rest,
    )
