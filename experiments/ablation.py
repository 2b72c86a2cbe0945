"""The same learner without a shield, without one but penalised, and with it, from one program."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from experiments import cli, console, pipeline, reconnaissance, tables, tasks, training
from rp_jax import evaluate, storage
from rp_jax.checkpoints import Checkpoints
from rp_jax.validate import number, one_of

RANDOM = 100  # stream of random numbers, apart from the pipeline's


def members_of(config: tasks.Config) -> list[training.Member]:
    """Of each seed: no shield; no shield, but danger penalised; the shield."""
    cases = [(float("inf"), 0.0), (float("inf"), config.penalty), (config.x, 0.0)]
    seeds = range(config.seed, config.seed + config.seeds)
    return [training.Member(seed, x, penalty) for x, penalty in cases for seed in seeds]


def at_random(
    task: tasks.Task, config: tasks.Config, models: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """One row per variant for all actions alike, and for all admissible actions alike."""
    key = tasks.key_of(config.seed, RANDOM)

    def policy(key: jax.Array, percept: Any) -> tuple[jax.Array, jax.Array]:
        values = jax.random.uniform(key, percept.threat.shape)
        return evaluate.shielded(lambda _: values)(key, percept)

    @jax.jit
    def play(pmdp: Any) -> evaluate.Episodes:
        return evaluate.play_episodes(key, pmdp, policy, config.episodes)

    rows = []
    for variant, params in task.tests.items():
        for x in (float("inf"), config.x):
            own = dataclasses.replace(config, x=x)
            episodes = play(tasks.make_pmdp(task, own, models, params))
            method = "random" if x == float("inf") else f"random, shield (x={x:g})"
            evaluate.check(episodes, method)
            found = evaluate.summarise(episodes, config.penalty)
            rows.append({"variant": variant, "method": method, "x": x, "seed": config.seed} | found)
    return rows


def show(name: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """One line per variant and method on the terminal."""
    shown = [
        {
            "variant": row["variant"],
            "method": row["method"],
            "return": tables.earned(row),
            "crashes": tables.crashed(row),
            "% [95 %]": tables.percent(row),
            "goal": f"{row['goal_rate']:.3f}",
        }
        for row in rows
    ]
    console.table(name, shown, list(shown[0]))


def main(
    name: str,
    about: str,
    presets: Mapping[str, Callable[[str], Any]],
    make_task: Callable[[Any], tasks.Task],
    argv: Sequence[str] | None = None,
) -> Path:
    """The comparison from the command line; arguments are those of `cli.main`."""

    def checked(config: tasks.Config) -> tasks.Task:
        number("x", config.x, least=0)  # finite: there is a shield to compare
        number("learning_penalty", config.learning_penalty, least=0, most=0)  # it is `penalty`
        one_of("learning_penalty_from", config.learning_penalty_from, [None])
        return make_task(config)

    return cli.main(name, about, presets, checked, argv, run)


def run(task: tasks.Task, config: tasks.Config, folder: Path, checkpoints: Checkpoints) -> None:
    """The comparison, into a prepared folder: table.json and learning_curves.png."""
    models, _, _ = reconnaissance.learn_threats(task, config, folder, checkpoints)
    assert models is not None  # x is finite
    pmdp, members = tasks.make_pmdp(task, config, models, task.train), members_of(config)
    trained, found = pipeline.plan_and_evaluate(task, config, pmdp, members, folder, checkpoints)
    rows = at_random(task, config, models) + found
    rows.sort(key=lambda row: list(task.tests).index(row["variant"]))
    show(task.name, rows)
    storage.write_json(folder / "table.json", rows)
    if config.figures:
        from rp_jax.plot import curves

        curves.methods({task.name: trained.history}, folder / "learning_curves.png")
    console.say(f"results: {folder}")
