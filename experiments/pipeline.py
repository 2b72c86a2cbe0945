"""The main job, task by task: reconnaissance, planning, evaluation, tables and figures."""

import datetime
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments import console, evaluation, planning, reconnaissance, tables, tasks
from experiments.training import Member, Trained
from rp_jax import devices, storage
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.planning import loop
from rp_jax.planning.networks import POOLS
from rp_jax.planning.pmdp import PMDP
from rp_jax.threat import artefact
from rp_jax.validate import one_of


class Finished(NamedTuple):
    """A run, for drawing."""

    task: tasks.Task
    config: Any  # the task's own settings
    pmdp: PMDP
    trained: Trained
    rows: list[dict[str, Any]]
    curves: dict[str, list[dict[str, float]]]
    folder: Path  # for figures
    bar: console.Bar


def default_out(task: str, preset: str) -> Path:
    """results/TASK-PRESET-TIME, the time to the microsecond."""
    now = datetime.datetime.now().strftime("%Y%m%d-%H%M%S-%f")
    return Path("results") / f"{task}-{preset}-{now}"


def checked(make_task: Callable[[Any], tasks.Task], config: tasks.Config) -> tasks.Task:
    """Finds everything that can be wrong with the settings, before any long work.

    Raises:
        ValueError: a setting is out of range, or a file cannot be used.
    """
    config.validate()
    devices.connect(config.devices)
    devices.divides("seeds", config.seeds, devices.mesh_of(config.devices))
    task = make_task(config)
    if not task.tests:
        raise ValueError("tests is {}; the task must name at least one variant to be tested in")
    subs = task.env.sub_rmdps(task.train)
    for kind in subs:
        one_of(f"kind of hazard of {task.name}", kind, task.threats)
    for kind, threat in task.threats.items():
        threat.validate(kind)
    pool, bins = POOLS[config.planning.network], task.env.LIDAR_BINS
    if bins % pool:
        raise ValueError(f"LIDAR_BINS is {bins}; it must be a multiple of {pool}")
    if config.threat is not None:
        artefact.load(config.threat, task.name, subs)
    return task


def prepare(
    make_task: Callable[[Any], tasks.Task], config: tasks.Config, preset: str
) -> tuple[tasks.Task, Path]:
    """`checked`, and the new folder for the results.

    Raises:
        ValueError: a setting is out of range, or a file or the folder cannot be used.
    """
    task = checked(make_task, config)
    if not devices.is_first():  # what the others write is thrown away
        return task, Path(tempfile.mkdtemp())
    return task, storage.new_folder(config.out or default_out(task.name, preset))


def run(task: tasks.Task, config: tasks.Config, folder: Path, checkpoints: Checkpoints) -> None:
    """The whole job, into a folder that has its config.json."""
    began, resumed = time.perf_counter(), checkpoints.begun()
    models, curves, parts = reconnaissance.learn_threats(task, config, folder, checkpoints)
    explored = time.perf_counter() - began
    pmdp, members = tasks.make_pmdp(task, config, models, task.train), tasks.members_of(config)
    trained, rows = plan_and_evaluate(task, config, pmdp, members, folder, checkpoints)
    tables.write(folder, rows)
    summary = {
        "steps": sum(row["steps"] for row in trained.history[-config.seeds :]),
        "crashes": sum(row["crashes"] for row in trained.history),
        "episodes": sum(row["episodes"] for row in trained.history),
        "inadmissible": sum(row["inadmissible"] for row in trained.history),
        "resumed": resumed,  # the seconds are then of the last process alone, but for planning
        "seconds": {
            "reconnaissance": explored,
            "reconnaissance_parts": parts,
            "planning": trained.seconds,
            "planning_compilation": trained.compile_seconds,
            "total_before_figures": time.perf_counter() - began,
        },
    }
    storage.write_json(folder / "training.json", summary)
    console.say(
        f"training: {summary['steps']:,} steps, {summary['crashes']} crashes in "
        f"{summary['episodes']:,} episodes, {summary['inadmissible']} inadmissible actions "
        f"taken; {trained.seconds:.1f} s after {trained.compile_seconds:.1f} s of compilation"
    )
    if config.figures and task.draw is not None:
        figures = folder / "figures"
        figures.mkdir(exist_ok=True)
        with console.progress("figures") as bar:
            task.draw(Finished(task, config, pmdp, trained, rows, curves, figures, bar))
    console.say(f"results: {folder}")


def plan_and_evaluate(
    task: tasks.Task,
    config: tasks.Config,
    pmdp: PMDP,
    members: Sequence[Member],
    folder: Path,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> tuple[Trained, list[dict[str, Any]]]:
    """`plan` into a folder, created if missing, then `evaluate_all`."""
    folder.mkdir(exist_ok=True)
    trained = planning.plan(config, pmdp, members, folder, checkpoints.at("planning"))
    network = loop.make_network(config.planning, pmdp)
    names = [tasks.method_name(config, member) for member in members]
    agents = evaluation.Agents(members, names, evaluation.greedily(network), trained)
    return trained, evaluation.evaluate_all(
        task, config, pmdp, agents, checkpoints.at("evaluation")
    )
