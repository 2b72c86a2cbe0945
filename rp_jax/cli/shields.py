"""An experiment that compares acting and learning without a shield, penalised, and with it."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax

from rp_jax import storage
from rp_jax.cli import terminal
from rp_jax.cli.experiment import Run
from rp_jax.runs import ablation, tables, training
from rp_jax.runs.progress import OnProgress
from rp_jax.runs.train import TrainConfig, threat_of
from rp_jax.validate import number, one_of


def check(config: TrainConfig) -> None:
    """Raises ValueError, naming it, if a setting has no place in the comparison.

    To be called before any work, where a run's world is made.

    Args:
        config: whose threshold is finite, and which has no penalty of its own.
    """
    number("x", config.x, least=0)  # finite: there is a shield to compare
    number("learning_penalty", config.learning_penalty, least=0, most=0)  # it is `penalty`
    one_of("learning_penalty_from", config.learning_penalty_from, [None])
    one_of("shield", config.shield, [True])
    one_of("c", config.c, [None])  # what is compared goes by x


def job(run: Run, bar: OnProgress) -> None:
    """Compares shields in a prepared folder; writes table.json, metrics.jsonl and a figure.

    Args:
        run: with settings that pass `check`.
        bar: of the progress.

    Raises:
        ValueError: a setting has no place in the comparison.
    """
    config = run.config
    check(config)
    key, params = jax.random.key(0), run.world.params()
    threat = threat_of(key, run.world, config, run.threats, run.folder, run.process, bar)
    agents, table = ablation.compare_shields(
        key,
        run.world.env,
        params,
        threat,
        x=config.x,
        penalty=config.penalty,
        tests={name: run.world.params(name) for name in run.world.tests},
        seeds=list(range(config.seed, config.seed + config.seeds)),
        config=config.planning,
        lookahead=config.lookahead,
        insecure_penalty=config.insecure_penalty,
        episodes=config.episodes,
        folder=run.folder,
        settings=run.world.settings,
        devices=run.process.devices,
        on_progress=bar,
    )
    rows = [{**row, "env": run.world.name} for row in table]
    show(run.world.name, rows)
    storage.write_json(run.folder / "table.json", rows)
    history = [row for of in agents for row in of.history]
    training.write_lines(run.folder / "metrics.jsonl", history)
    if run.process.figures:
        from rp_jax.plot import curves

        curves.methods({run.world.name: history}, run.folder / "learning_curves.png")


def show(name: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints one line per test and method.

    Args:
        name: of the world.
        rows: of the comparison.
    """
    shown = [
        {
            "variant": row["variant"],
            "method": row["method"],
            "return": tables.earned(row),
            "crashes": tables.crashed(row),
            **tables.rates(row),
            "hit": tables.hits(row["collisions"]),
            "goal": f"{row['goal_rate']:.3f}",
        }
        for row in rows
    ]
    terminal.table(name, shown, list(shown[0]))
