"""Reconnaissance as a job: the threat function of a world, learned and judged (Algorithm 2)."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import rp_jax
from rp_jax import devices as sharing
from rp_jax import recipes, recording, storage
from rp_jax.checkpoints import Checkpoints
from rp_jax.envs.check import check_contract
from rp_jax.envs.contract import Env
from rp_jax.planning.pmdp import PMDP
from rp_jax.recon import labels
from rp_jax.runs import record
from rp_jax.runs.progress import OnProgress, silent
from rp_jax.shield import threshold_array
from rp_jax.streams import Stream, key_of
from rp_jax.threat import artefact, build, report
from rp_jax.threat.build import ThreatConfig
from rp_jax.threat.correction import Statement, SumCorrection, calibrated_sum
from rp_jax.threat.function import ThreatFunction, load_threat
from rp_jax.threat.total import total_threat
from rp_jax.validate import number, one_of, path, random_key, shown

VISITED = 256  # states of the world that sums of threats are judged on
CALIBRATION_SHARE = 0.25  # of the rollouts of a label; noise in labels makes calibration stricter


def reconnoitre(
    key: Array,
    env: Env,
    params: Any,
    *,
    x: float = 0.01,
    miss_rate: float = 0.05,
    config: ThreatConfig | Mapping[str, ThreatConfig] | None = None,
    folder: str | Path | None = None,
    devices: str = "one",
    on_progress: OnProgress = silent,
) -> ThreatFunction:
    """Learns how dangerous each action is, under the world's baseline policy (Algorithm 2).

    The threat of one hazard of each kind is learned from simulations that start anywhere; that of
    a state is the sum over its hazards (Theorem 3).

    Args:
        key: of everything random in it.
        env: the world, `rp_jax.envs.contract.Env`.
        params: its parameters.
        x: the threshold near which the threat has to be known best; others may be used later.
        miss_rate: of the states that the world comes by with an action above a level of threat, the
            greatest share that may have one called less: the sums are raised until that is shown,
            with 95 % confidence for all levels (`threat.correction`); 1: they stay as they are.
        config: sizes and settings, of all kinds of hazard or by kind; tuned ones by default.
        folder: created if missing, where the threat function, its reports and, while it is
            learned, checkpoints are kept: the same call goes on where it was interrupted, and
            returns at once what is finished. What another call left there is an error.
        devices: "one", "all" or "cluster" (docs/devices.md).
        on_progress: called with (stage, done, total, note).

    Returns:
        The threat function, with its reports in `about`.

    Raises:
        ValueError: a setting is out of range, the world breaks the contract, or the folder holds
            something else; before any work.
        FloatingPointError: a label, a loss or a weight is not a finite number.
    """
    random_key("key", key)
    number("x", x, above=0)
    number("miss_rate", miss_rate, above=0, most=1)
    one_of("devices", devices, sharing.DEVICES)
    check_contract(env, params)
    subs = env.sub_rmdps(params)
    settings = settings_of(config, subs)
    spec = {
        "env": record.name_of(env),
        "key": record.key_data(key),
        "x": x,
        "miss_rate": miss_rate,
        "settings": settings,
        "params": record.digest_of((subs, params)),
    }
    where = None if folder is None else path("folder", folder)
    if where is not None and (where / "manifest.json").exists():
        return _finished(where, subs, record.plain(spec))
    with record.job(where, "threat", {**spec, **record.machine(env)}) as checkpoints:
        return _learned(
            *(key, env, params, x, miss_rate, settings),
            *(spec, where, devices, on_progress, checkpoints),
        )


def settings_of(
    config: ThreatConfig | Mapping[str, ThreatConfig] | None, subs: Mapping[str, Any]
) -> dict[str, ThreatConfig]:
    """Returns the settings of each kind of hazard, checked.

    Args:
        config: of all kinds, by kind, or None for tuned ones.
        subs: by kind, the sub-R-MDPs.

    Raises:
        ValueError: a setting is out of range, or names a kind that there is not.
    """
    if isinstance(config, Mapping):
        for kind in config:
            one_of("config: kind of hazard", kind, subs)
    elif not (config is None or isinstance(config, ThreatConfig)):
        raise ValueError(f"config is {shown(config)}; it must be a ThreatConfig, or one by kind")
    found = {}
    for kind, sub in subs.items():
        own = config.get(kind) if isinstance(config, Mapping) else config
        found[kind] = own or recipes.tuned(sub)
        build.check_config(kind, found[kind], sub)
    return found


def _finished(folder: Path, subs: Mapping[str, Any], spec: Mapping[str, Any]) -> ThreatFunction:
    """A threat function that was learned before, by the same call."""
    record.compared(f"folder is {folder}", artefact.about(folder).get("spec") or {}, spec)
    return load_threat(folder, subs)


def _learned(
    key: Array,
    env: Env,
    params: Any,
    x: float,
    miss_rate: float,
    settings: Mapping[str, ThreatConfig],
    spec: Mapping[str, Any],
    folder: Path | None,
    devices: str,
    on_progress: OnProgress,
    checkpoints: Checkpoints,
) -> ThreatFunction:
    subs = env.sub_rmdps(params)
    mesh = sharing.mesh_of(devices)
    keys = jax.random.split(key_of(key, Stream.THREAT), max(1, len(subs)))
    built = {}
    for own, kind in zip(keys, sorted(subs), strict=False):

        def tell(stage: str, done: int, total: int, kind: str = kind) -> None:
            on_progress(f"threat of {kind}: {stage}", done, total, "")

        at = checkpoints.at(kind)
        built[kind] = build.learn_threat(own, subs[kind], settings[kind], x, tell, mesh, at)
    models = sharing.broadcast_first({kind: b.model for kind, b in built.items()})
    reports = {kind: b.report for kind, b in built.items()}
    common: dict[str, Any] = {"x": x, "on_progress": on_progress, "checkpoints": checkpoints}
    sums = judged_sums(key, env, params, models, settings, **common)
    correction: SumCorrection | None = None
    statements: list[Statement] = []
    if models and miss_rate < 1:
        count = min(settings[kind].test_states for kind in models)
        said, true = drawn_sums(
            *(key, env, params, models, settings, Stream.CALIBRATION, count),
            paths_share=CALIBRATION_SHARE,
            **common,
        )
        correction, statements = calibrated_sum(sum(said.values()), sum(true.values()), miss_rate)
    about = {
        "x": x,
        "correction": None if correction is None else correction.points,
        "statements": [found._asdict() for found in statements],
        "reports": reports,
        "sums": sums,
        "settings": {kind: dataclasses.asdict(config) for kind, config in settings.items()},
        "seconds": {kind: b.seconds for kind, b in built.items()},
        "spec": record.plain(spec),
        "version": rp_jax.__version__,
    }
    found = ThreatFunction(dict(models), dict(subs), about)
    if folder is not None:
        curves = {kind: b.curve for kind, b in built.items()}
        storage.write_json(folder / "report.json", report_rows(found))
        storage.write_json(folder / "curves.json", curves)
        found.save(folder, record.name_of(env))
    return found


def report_rows(threat: ThreatFunction) -> list[dict[str, Any]]:
    """Returns how good the models are: a row for single hazards and one for the sum, by kind.

    Args:
        threat: as `reconnoitre` returns it.
    """
    reports, sums = threat.about.get("reports", {}), threat.about.get("sums", {})
    rows = [{"hazard": kind, "of": "one", **found} for kind, found in reports.items()]
    return rows + [{"hazard": kind, "of": "sum", **found} for kind, found in sums.items()]


def judged_sums(
    key: Array,
    env: Env,
    params: Any,
    models: Mapping[str, Any],
    settings: Mapping[str, ThreatConfig],
    *,
    x: float,
    on_progress: OnProgress,
    checkpoints: Checkpoints,
) -> dict[str, dict[str, float]]:
    """Compares the models' sums with accurate ones, on states that the world comes by.

    Args:
        key: its streams are apart from those that the models were learned from.
        env: the world.
        params: its parameters.
        models: by kind of hazard.
        settings: by kind; says how many rollouts an accurate label takes.
        x: the threshold at which decisions are compared.
        on_progress: called with (stage, done, total, note).
        checkpoints: of the labels.

    Returns:
        By kind, the errors and wrong decisions of `report.compare`.
    """
    if not models:
        return {}
    said, true = drawn_sums(
        *(key, env, params, models, settings, Stream.SUMS, VISITED),
        x=x,
        on_progress=on_progress,
        checkpoints=checkpoints,
    )
    return {kind: report.compare(said[kind], true[kind], x) for kind in sorted(models)}


def drawn_sums(
    key: Array,
    env: Env,
    params: Any,
    models: Mapping[str, Any],
    settings: Mapping[str, ThreatConfig],
    stream: Stream,
    count: int,
    *,
    x: float,
    on_progress: OnProgress,
    checkpoints: Checkpoints,
    paths_share: float = 1.0,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Returns the models' sums over hazards and accurate ones, on states that the world comes by.

    Args:
        key: of everything random in it.
        env: the world.
        params: its parameters.
        models: by kind of hazard.
        settings: by kind; says how many rollouts an accurate label takes.
        stream: what the states are for.
        count: of states.
        x: the threshold behind which they are visited.
        on_progress: called with (stage, done, total, note).
        checkpoints: of the labels.
        paths_share: of the rollouts of an accurate label.

    Returns:
        By kind (count, A): what the models say, and what is true.
    """
    walk, *keys = jax.random.split(key_of(key, stream), 1 + len(models))
    pmdp = PMDP(
        params=params,
        threats=dict(models),
        x=threshold_array(x),
        penalty=jnp.zeros(()),
        insecure_penalty=jnp.zeros(()),
        env=env,
        pool=1,
    )
    states = jax.jit(recording.visited_states, static_argnums=2)(walk, pmdp, count)
    hazards = jax.jit(jax.vmap(env.hazards, (0, None)))(states, params)
    subs, said, found = env.sub_rmdps(params), {}, {}
    for kind, own in zip(sorted(models), keys, strict=True):
        stage = f"{stream.name.lower()} over {kind}s"
        on_progress(stage, 0, 1, "")
        paths = max(2, round(paths_share * settings[kind].test_paths))
        estimator = labels.best_estimator(subs[kind], paths)
        at = checkpoints.at(f"{stream.name.lower()} {kind}")
        found[kind] = report.labelled_sum(
            own, states.body, hazards[kind], subs[kind], estimator, at
        )
        only = {kind: models[kind]}
        given = {kind: hazards[kind]}
        said[kind] = np.asarray(jax.jit(total_threat)(only, states.body, given))
        on_progress(stage, 1, 1, "")
    return said, found
