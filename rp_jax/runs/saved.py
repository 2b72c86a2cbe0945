"""Agents and threat functions in folders: saved whole, and loaded for the world they are of."""

import dataclasses
import importlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rp_jax
from rp_jax import storage
from rp_jax.envs import optional
from rp_jax.envs.contract import FUNCTIONS, Env
from rp_jax.planning import loop
from rp_jax.planning.budgeted import unwrapped, with_budget
from rp_jax.planning.loop import LoopConfig
from rp_jax.planning.networks import POOLS
from rp_jax.planning.percept import Encoded, encode
from rp_jax.planning.pmdp import PMDP
from rp_jax.runs import record, training
from rp_jax.runs.agents import Agent, Agents, Member
from rp_jax.runs.dataclass_json import restored
from rp_jax.threat import artefact
from rp_jax.threat.function import ThreatFunction, load_threat
from rp_jax.validate import number, path, shown

AGENTS, THREAT = "agent", "threat"  # folders inside that of a run
METRICS = "metrics.jsonl"  # curves of a run
KIND = "agents"


def save(
    folder: str | Path,
    thing: Agents | ThreatFunction,
    settings: Mapping[str, Any] | None = None,
) -> None:
    """Saves agents, with their curves and their threat function, or a threat function alone.

    Args:
        folder: created if missing; what was saved there before is replaced, and lost if this is
            stopped half-way.
        thing: what `plan` or `reconnoitre` returned.
        settings: keywords of the environment's `make_params` that made the parameters, so that
            agents can be loaded without these; `make_params()` is tried where none are given.

    Raises:
        ValueError: it is neither.
        storage.StorageError: it cannot be written.
    """
    folder = path("folder", folder)
    if not isinstance(settings, Mapping | None):
        raise ValueError(f"settings is {shown(settings)}; it must be keywords of make_params")
    if isinstance(thing, Agent):
        raise ValueError("thing is one Agent; it must be Agents: save agents[0:1]")
    if isinstance(thing, ThreatFunction):
        thing.save(folder)
    elif isinstance(thing, Agents):
        save_agents(folder, thing, {"settings": dict(settings or {})})
    else:
        raise ValueError(f"thing is {shown(thing)}; it must be Agents or a ThreatFunction")


def load(folder: str | Path, env: Env | None = None, params: Any = None) -> Any:
    """Loads what `save`, `reconnoitre` or `plan` left in a folder.

    Args:
        folder: of agents, or of a threat function.
        env: the world; by default it is imported by its name.
        params: its parameters; by default they are made anew, as those that were learned with.

    Returns:
        `Agents`, or a `ThreatFunction` if the folder holds that alone.

    Raises:
        storage.StorageError: something is missing, damaged, or of another world; or the world or
            its parameters cannot be found by themselves and must be given.
    """
    folder = path("folder", folder)
    if not folder.is_dir():
        raise storage.StorageError(f"folder is {folder}; there is no such folder")
    alone = not (folder / AGENTS / "manifest.json").exists()  # a threat function, without agents
    if alone and not (folder / "manifest.json").exists():
        raise storage.StorageError(
            f"folder is {folder}; it must hold agents or a threat function, but has no "
            f"{AGENTS}/manifest.json and no manifest.json"
        )
    about = artefact.about(folder) if alone else about_agents(folder)
    world = _checked_env(_world(about) if env is None else env)
    if params is not None and not hasattr(params, "body"):
        raise ValueError(f"params is {shown(params)}; it must be parameters of the environment")
    if alone:
        found = params if params is not None else _made(world, {}, folder)
        return load_threat(folder, world.sub_rmdps(found))
    if params is None:
        params = _parameters(folder, world, about)
    threat = None
    if about.get("shielded", True):
        threat = _threat(folder / THREAT, world.sub_rmdps(params), about.get("threat"))
    config = restored(LoopConfig, about.get("config"), f"{folder}: config")
    pmdp = PMDP(
        params=params,
        threats={} if threat is None else dict(threat.models),
        correction=None if threat is None else threat.correction,
        x=jnp.zeros(()),
        penalty=jnp.zeros(()),
        insecure_penalty=jnp.asarray(float(about.get("insecure_penalty", 0.0))),
        env=world,
        pool=POOLS[config.network],
        lookahead=int(about.get("lookahead", 0)),
        refunds=int(about.get("refunds", 0)),
        shielded=threat is not None,
    )
    if promised := about.get("c"):
        budget, spread = with_budget(world, params, *promised)
        pmdp = pmdp.replace(env=budget, params=spread)
    return restored_agents(folder, about, pmdp, threat)


def _threat(folder: Path, subs: Mapping[str, Any], checksum: Any) -> ThreatFunction:
    """Returns the threat function of a run; one without models may not have been kept."""
    if not subs and not folder.is_dir():
        return ThreatFunction({}, {})
    found = load_threat(folder, subs)
    if checksum is not None and (there := artefact.saved_checksum(folder)) != checksum:
        raise storage.StorageError(
            f"{folder}: the threat function's checksum is {there}; it must be {checksum}, that of "
            "the one which the agents were saved with"
        )
    return found


def imported(name: Any) -> Any:
    """Returns the environment of a name.

    Args:
        name: of a module, such as "rp_jax.envs.jam".

    Raises:
        storage.StorageError: there is no such module.
    """
    try:
        return importlib.import_module(str(name))
    except (ImportError, TypeError, ValueError) as error:  # the latter two of names like ".world"
        raise storage.StorageError(
            f"env is {name!r}, which cannot be imported ({error}); it must be a module, such as "
            "rp_jax.envs.jam; one's own must be in the folder of the call, or on PYTHONPATH"
        ) from error


def _checked_env(env: Any) -> Any:
    """Returns an environment, if it has the functions of one."""
    for name in FUNCTIONS:
        if not callable(getattr(env, name, None)):
            raise storage.StorageError(
                f"env is {record.name_of(env)}; it must be an environment, but has no `{name}`"
            )
    return env


def _world(about: Mapping[str, Any]) -> Any:
    """Returns the environment that the facts of a file name."""
    name = about.get("env") or about.get("environment")
    if not name:
        raise storage.StorageError(
            "the file does not name its environment; it must be given: load(folder, env=...)"
        )
    try:
        return imported(name)
    except storage.StorageError as error:
        raise storage.StorageError(f"{error}; or give it: load(folder, env=...)") from error


def _made(env: Any, settings: Mapping[str, Any], where: Path) -> Any:
    if not hasattr(env, "make_params"):
        raise storage.StorageError(
            f"{where}: {record.name_of(env)} has no make_params; params must be given"
        )
    try:
        return env.make_params(**settings)
    except (TypeError, ValueError) as error:
        raise storage.StorageError(
            f"{where}: the settings {dict(settings)} do not fit {record.name_of(env)}.make_params "
            f"({error}); the world must be the one that was saved, or params must be given"
        ) from error


def save_agents(folder: Path, agents: Agents, more: Mapping[str, Any]) -> None:
    """Saves agents, their curves, and the threat function that they go by, inside a folder.

    Args:
        folder: created if missing.
        agents: to be saved.
        more: facts to be kept with them; `settings` are the keywords of `make_params`.

    Raises:
        storage.StorageError: it cannot be written.
    """
    seen = _seen(agents.pmdp.env, agents.pmdp.params, agents.pmdp.pool)
    env, params = unwrapped(agents.pmdp.env, agents.pmdp.params)
    network = agents.network
    if agents.threat is not None:
        agents.threat.save(folder / THREAT, record.name_of(env))
    settings = dict(more.get("settings") or {})
    facts, arrays = _difference(env, settings, params)
    about = {
        "env": record.name_of(env),
        "settings": settings,
        "params": facts,
        "members": [member._asdict() for member in agents.members],
        "methods": list(dict.fromkeys(agents.methods)),
        "config": dataclasses.asdict(agents.config),
        "observation": {"scan": seen.scan.shape[-1], "rest": seen.rest.shape[-1]},
        "num_actions": agents.pmdp.num_actions,
        "scale": list(getattr(network, "scale", ())),
        "shielded": agents.pmdp.shielded,
        "threat": None if agents.threat is None else agents.threat.checksum,
        "lookahead": agents.pmdp.lookahead,
        "c": None if agents.promised is None else list(agents.promised),
        "refunds": agents.pmdp.refunds,
        "insecure_penalty": float(agents.pmdp.insecure_penalty),
        "seconds": agents.seconds,
        "version": rp_jax.__version__,
        **{name: value for name, value in more.items() if name != "settings"},
    }
    tree = {"weights": agents.weights, "params": arrays}
    storage.save(folder / AGENTS, KIND, tree, about)
    training.write_lines(folder / METRICS, agents.history)


def about_agents(folder: Path) -> dict[str, Any]:
    """Returns the facts that were saved with agents.

    Args:
        folder: of the run.

    Raises:
        storage.StorageError: there are none, or they are damaged.
    """
    return storage.read_manifest(folder / AGENTS, KIND)["about"]


def restored_agents(
    folder: Path, about: Mapping[str, Any], pmdp: PMDP, threat: ThreatFunction | None
) -> Agents:
    """Reads the weights of saved agents.

    Args:
        folder: of the run.
        about: the facts that were saved with them.
        pmdp: what they act in.
        threat: that they go by.

    Raises:
        storage.StorageError: they are missing, damaged, or of another shape.
    """
    where = f"{folder / AGENTS}"
    config = restored(LoopConfig, about.get("config"), f"{where}: config")
    members = tuple(
        restored(Member, row, f"{where}: members") for row in about.get("members") or ()
    )
    sizes = [about.get("observation", {}).get(name) for name in ("scan", "rest")]
    for size in sizes:
        number(f"{where}: observation", size, least=0, most=10**6, integer=True)
    number(f"{where}: members", len(members), least=1, most=1000, integer=True)
    network = loop.make_network(config, pmdp)
    shapes_of = jax.ShapeDtypeStruct
    seen: Any = Encoded(
        scan=shapes_of((1, sizes[0]), jnp.uint8),  # type: ignore[arg-type]
        rest=shapes_of((1, sizes[1]), jax.dtypes.canonicalize_dtype(float)),  # type: ignore[arg-type]
    )
    try:
        shapes = jax.eval_shape(network.init, jax.random.key(0), seen)
    except (TypeError, ValueError) as error:
        raise storage.StorageError(
            f"{where}: the network does not fit the environment ({error})"
        ) from error
    weights = jax.tree.map(
        lambda s: jax.ShapeDtypeStruct((len(members), *s.shape), s.dtype), shapes
    )
    like = {"weights": weights, "params": _claimed(folder)}
    tree = storage.load(folder / AGENTS, KIND, like, convert=True)
    history = _history(folder / METRICS)
    return Agents(
        pmdp,
        network,
        tree["weights"],
        members,
        config,
        threat,
        history,
        dict(about.get("seconds") or {}),
    )


def _history(file: Path) -> list[dict[str, Any]]:
    """Returns the rows of metrics.jsonl, if it is there; nan is null in it."""
    nan = float("nan")
    try:
        rows = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
        return [{k: nan if v is None else v for k, v in row.items()} for row in rows]
    except (OSError, ValueError, AttributeError, RecursionError) as error:
        raise storage.StorageError(f"{file}: cannot be read ({error})") from error


def _seen(env: Env, params: Any, pool: int) -> Encoded:
    """The shapes of an encoded observation, without computing one."""
    size, bins = optional.observation_size(env, params), optional.lidar_bins(env)
    like = jax.ShapeDtypeStruct((size,), jax.dtypes.canonicalize_dtype(float))
    return jax.eval_shape(lambda seen: encode(seen, bins, pool), like)


def _difference(
    env: Any, settings: Mapping[str, Any], params: Any
) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """What tells parameters from `make_params(**settings)`: static fields, and arrays by path.

    None where they have another structure, so that they cannot be made anew.
    """
    try:
        made = env.make_params(**settings)
    except (AttributeError, TypeError, ValueError):
        return None, {}
    had, have = storage.leaves(made), storage.leaves(params)
    old, new = storage.statics(made), storage.statics(params)
    odd = {name: value for name, value in new.items() if old.get(name) != value}
    simple = all(isinstance(v, str | int | float | bool) for v in odd.values())
    plain = not any("." in name or "~" in name for name in have)  # paths are told apart below
    if had.keys() != have.keys() or old.keys() != new.keys() or not (simple and plain):
        return None, {}
    changed = {
        name.replace("/", "."): value
        for name, value in have.items()
        if not np.array_equal(value, had[name], equal_nan=value.dtype.kind == "f")
    }
    return {"statics": odd}, changed


def _claimed(folder: Path) -> dict[str, Any]:
    """Shapes of the arrays that parameters differ by, as the manifest has them."""
    arrays = storage.read_manifest(folder / AGENTS, KIND)["arrays"]
    try:
        return {
            name.removeprefix("params/"): jax.ShapeDtypeStruct(
                tuple(facts["shape"]), jnp.dtype(facts["dtype"])
            )
            for name, facts in arrays.items()
            if name.startswith("params/")
        }
    except (TypeError, KeyError, ValueError) as error:
        raise storage.StorageError(f"{folder / AGENTS}: arrays cannot be read ({error})") from error


def _parameters(folder: Path, env: Any, about: Mapping[str, Any]) -> Any:
    """The parameters that agents learned with, made anew."""
    where = folder / AGENTS
    facts = about.get("params")
    if not isinstance(facts, dict):
        raise storage.StorageError(
            f"{where}: the parameters cannot be made anew, since the settings of make_params were "
            "not given when they were saved; they must be given: load(folder, env, params)"
        )
    made = _made(env, about.get("settings") or {}, where)
    claimed = _claimed(folder)
    if claimed:
        changed = storage.load_some(where, KIND, {f"params/{n}": s for n, s in claimed.items()})
        flat, structure = jax.tree_util.tree_flatten_with_path(made)
        names = [jax.tree_util.keystr(p, simple=True, separator=".") for p, _ in flat]
        odd = set(claimed) - set(names)
        if odd:
            raise storage.StorageError(f"{where}: parameters have no {', '.join(sorted(odd))}")
        values = [
            jnp.asarray(changed[f"params/{n}"], jnp.asarray(a).dtype) if n in claimed else a
            for n, (_, a) in zip(names, flat, strict=True)
        ]
        made = jax.tree.unflatten(structure, values)
    return _with_statics(made, facts.get("statics") or {})


def _with_statics(part: Any, statics: Mapping[str, Any], above: str = "") -> Any:
    """A tree of dataclasses with some static fields replaced."""
    changes = {}
    for field in dataclasses.fields(part) if dataclasses.is_dataclass(part) else ():
        name = above + field.name
        if not field.metadata.get("pytree_node", True):
            if name in statics:
                changes[field.name] = statics[name]
        elif any(key.startswith(f"{name}/") for key in statics):
            changes[field.name] = _with_statics(getattr(part, field.name), statics, f"{name}/")
    return dataclasses.replace(part, **changes) if changes else part
