"""The threat functions of a task: loaded, or learned and judged."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

import rp_jax
from experiments import console, tables, tasks
from rp_jax import devices, evaluate, storage
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.recon import labels
from rp_jax.threat import artefact, build, report
from rp_jax.threat.total import total_threat


def learn_threats(
    task: tasks.Task, config: tasks.Config, folder: Path, checkpoints: Checkpoints = NO_CHECKPOINTS
) -> tuple[dict | None, dict, dict]:
    """The threat models of all kinds of hazard: loaded or learned; and saved in `folder`.

    Returns:
        (models, curves, timings), the latter two empty if loaded; None for no shield.
    """
    subs = task.env.sub_rmdps(task.train)
    if np.isinf(config.x):
        return None, {}, {}
    if not subs:
        return {}, {}, {}
    if config.threat is not None:
        models = artefact.load(config.threat, task.name, subs)
        about = storage.read_manifest(config.threat, artefact.KIND)["about"]
        artefact.save(folder / "threat", task.name, models, subs, about)  # the folder is whole
        return models, {}, {}
    built = {}
    keys = jax.random.split(tasks.key_of(config.seed, tasks.THREAT), len(subs))
    for key, kind in zip(keys, sorted(subs), strict=True):
        with console.progress(f"threat of {kind}") as bar:
            threat, at = task.threats[kind], checkpoints.at("threat").at(kind)
            mesh = devices.mesh_of(config.devices)
            built[kind] = build.build(key, subs[kind], threat, config.x, bar, mesh, at)
    models = devices.agreed({kind: b.model for kind, b in built.items()})
    reports = {kind: b.report for kind, b in built.items()}
    timings = {kind: b.seconds for kind, b in built.items()}
    sums = sum_reports(
        tasks.key_of(config.seed, tasks.SUMS), task, config, models, checkpoints.at("sums")
    )
    curves = {kind: b.curve for kind, b in built.items()}
    about = {
        "x": config.x,
        "reports": reports,
        "sums": sums,
        "settings": {k: dataclasses.asdict(v) for k, v in task.threats.items()},
        "seed": config.seed,
        "version": rp_jax.__version__,
    }
    artefact.save(folder / "threat", task.name, models, subs, about)
    rows = [{"hazard": kind, "of": "one", **found} for kind, found in reports.items()]
    rows += [{"hazard": kind, "of": "sum", **found} for kind, found in sums.items()]
    tables.show_threats(rows, config.x)
    storage.write_json(folder / "threat" / "report.json", rows)
    storage.write_json(folder / "threat" / "curves.json", curves)
    return models, curves, timings


def sum_reports(
    key: jax.Array,
    task: tasks.Task,
    config: tasks.Config,
    models: Mapping,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> dict:
    """By kind of hazard, the models' sums against accurate ones on states of the task."""
    walk, *keys = jax.random.split(key, 1 + len(models))
    pmdp = tasks.make_pmdp(task, config, models, task.train)
    states = jax.jit(evaluate.visited_states, static_argnums=2)(walk, pmdp, 256)
    hazards = jax.jit(jax.vmap(task.env.hazards, (0, None)))(states, task.train)
    subs = task.env.sub_rmdps(task.train)
    found = {}
    for kind, key in zip(sorted(models), keys, strict=True):
        estimator = labels.best_estimator(subs[kind], task.threats[kind].test_paths)
        with console.progress(f"sum over {kind}s") as bar:
            bar("", 0, 1)
            true = report.labelled_sum(
                key, states.agent, hazards[kind], subs[kind], estimator, checkpoints.at(kind)
            )
            only = {kind: models[kind]}
            said = jax.jit(total_threat)(only, states.agent, {kind: hazards[kind]})
            bar("", 1, 1)
        found[kind] = report.compare(np.asarray(said), true, config.x)
    return found
