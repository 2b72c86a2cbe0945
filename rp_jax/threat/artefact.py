"""Learned threat functions as files, for use with other thresholds, tracks or hazard counts."""

import math
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rp_jax import storage
from rp_jax.dynamics import num_threats
from rp_jax.hazards import SubRMDP
from rp_jax.threat.model import (
    ACTIVATIONS,
    DEEPEST,
    MOST_NODES,
    WIDEST,
    ThreatModel,
    ThreatNetwork,
    ThreatTable,
)

KIND = "threat function"


def save(
    folder: Path,
    environment: str,
    models: Mapping[str, ThreatModel],
    subs: Mapping[str, SubRMDP],
    about: Mapping[str, Any],
) -> None:
    """Saves the models of all kinds of hazard, with the sub-R-MDPs that they hold for.

    Args:
        folder: created if it is missing.
        environment: name of the environment, by which `rp_jax.load` finds it again.
        models: the models by kind of hazard.
        subs: the sub-R-MDPs by kind of hazard.
        about: other facts worth keeping, such as reports.

    Raises:
        storage.StorageError: the folder or a file cannot be written.
    """
    networks = {kind: _described(model.network) for kind, model in models.items()}
    statics = {kind: _texts(subs[kind]) for kind in models}
    facts = {**about, "environment": environment, "networks": networks, "statics": statics}
    storage.save(folder, KIND, _tree(models, subs), facts)


def checksum(models: Mapping[str, ThreatModel], subs: Mapping[str, SubRMDP]) -> str:
    """Returns the SHA-256 of the models and the sub-R-MDPs that they hold for, as `save` states it.

    Args:
        models: the models by kind of hazard.
        subs: the sub-R-MDPs by kind of hazard.
    """
    return storage.checksum(_tree(models, subs))


def _tree(models: Mapping[str, ThreatModel], subs: Mapping[str, SubRMDP]) -> dict[str, Any]:
    """Returns the arrays that are saved, by kind of hazard."""
    return {kind: {"model": models[kind], "sub": subs[kind]} for kind in models}


def saved_checksum(folder: Path) -> str:
    """Returns the SHA-256 that a saved threat function states.

    Args:
        folder: the folder given to `save`.

    Raises:
        storage.StorageError: there is no threat function, or it is damaged.
    """
    return str(storage.read_manifest(folder, KIND)["sha256"])


def load(
    folder: Path, subs: Mapping[str, SubRMDP]
) -> tuple[dict[str, ThreatModel], dict[str, SubRMDP]]:
    """Loads the models that `save` wrote.

    Args:
        folder: the folder given to `save`.
        subs: the sub-R-MDPs that the models must hold for, by kind of hazard.

    Returns:
        The models, and the sub-R-MDPs that they were saved with, by kind of hazard; converted,
        with a `storage.PrecisionWarning`, if they were saved in another precision.

    Raises:
        storage.StorageError: the file is damaged, or holds for another environment, other
            dynamics, another baseline policy or other hazards.
    """
    known = about(folder)
    networks: Any = known.get("networks")
    same_kinds(str(folder), networks, subs)
    for kind, sub in subs.items():
        _same_statics(f"{folder}: {kind}", known.get("statics", {}), kind, sub)
    like = {
        kind: {"model": _blank(folder, kind, networks[kind], sub), "sub": sub}
        for kind, sub in subs.items()
    }
    tree = storage.load(folder, KIND, like, convert=True)
    for kind, sub in subs.items():
        same_sub(f"{folder}: {kind}", tree[kind]["sub"], sub)
    models, known_subs = ({kind: tree[kind][part] for kind in subs} for part in ("model", "sub"))
    return models, known_subs


def about(folder: Path) -> dict[str, Any]:
    """Returns the facts that were saved with a threat function: reports, settings, networks.

    Args:
        folder: the folder given to `save`.

    Raises:
        storage.StorageError: there is no threat function, or it is damaged.
    """
    return storage.read_manifest(folder, KIND)["about"]


def same_kinds(where: str, found: Any, subs: Mapping[str, SubRMDP]) -> None:
    """Raises StorageError unless a threat function has an environment's kinds of hazard.

    Args:
        where: beginning of the message.
        found: the threat function's table with an entry for each kind of hazard.
        subs: the environment's sub-R-MDPs by kind of hazard.

    Raises:
        storage.StorageError: the kinds differ.
    """
    if not isinstance(found, Mapping) or set(found) != set(subs):
        kinds = sorted(found) if isinstance(found, Mapping) else found
        raise storage.StorageError(f"{where}: hazards are {kinds}; they must be {sorted(subs)}")


def same_sub(where: str, found: SubRMDP, wanted: SubRMDP) -> None:
    """Raises StorageError unless two sub-R-MDPs are equal up to rounding.

    Args:
        where: beginning of the message.
        found: the threat function's sub-R-MDP.
        wanted: the environment's sub-R-MDP.

    Raises:
        storage.StorageError: a number or a static field differs; the message names it.
    """
    have = storage.leaves(found)
    known = _texts(found)
    for name, text in _texts(wanted).items():
        if known.get(name, text) != text:
            raise storage.StorageError(
                f"{where}: {name} is {known[name]}; for this environment it must be {text}"
            )
    for name, value in storage.leaves(wanted).items():
        there = have.get(name)
        if (
            there is None
            or there.shape != value.shape
            or not np.allclose(value, there, rtol=1e-5, atol=1e-7)
        ):
            shown = None if there is None else there.tolist()
            raise storage.StorageError(
                f"{where}: {name} is {shown}; for this environment it must be {value.tolist()}"
            )


def _same_statics(where: str, saved: Any, kind: str, sub: SubRMDP) -> None:
    """Raises StorageError if a saved static field differs; files of earlier versions have none."""
    known = saved.get(kind, {}) if isinstance(saved, dict) else None
    if not isinstance(known, dict):
        raise storage.StorageError(f"{where}: statics is {known!r}; it must be a table")
    for name, value in _texts(sub).items():
        if (found := known.get(name, value)) != value:
            shown, wanted = (textwrap.shorten(str(text), 80) for text in (found, value))
            raise storage.StorageError(
                f"{where}: {name} is {shown}; for this environment it must be {wanted}"
            )


def _texts(sub: SubRMDP) -> dict[str, str]:
    """Returns the static fields of a sub-R-MDP (a horizon, a body's model) as texts, by path."""
    return {name: storage.text(value) for name, value in storage.statics(sub).items()}


def _described(network: ThreatNetwork | ThreatTable) -> dict[str, Any]:
    """Returns the facts from which `_blank` makes a network or a table."""
    if isinstance(network, ThreatTable):
        return {"shape": network.shape}
    return {"hidden": network.hidden, "activation": network.activation}


def _blank(folder: Path, kind: str, facts: Any, sub: SubRMDP) -> ThreatModel:
    """Returns a model of the saved structure, with shapes in place of its weights."""
    features = jax.eval_shape(
        lambda key: sub.source.features(*sub.source.sample(key, sub.body)), jax.random.key(0)
    )
    network = _network(f"{folder}: {kind}", facts, num_threats(sub.body), features.shape[0])
    shapes = jax.eval_shape(network.init, jax.random.key(0), features)
    return ThreatModel(sub.source, shapes, features, jnp.zeros(()), network)


def _network(where: str, facts: Any, actions: int, size: int) -> ThreatNetwork | ThreatTable:
    """Returns a network or a table from its saved facts, checked.

    Args:
        where: beginning of a message.
        facts: as `_described` returned them.
        actions: number of threats.
        size: number of features.
    """
    if isinstance(facts, dict) and "shape" in facts:
        shape = facts["shape"]
        good = isinstance(shape, list) and len(shape) == size
        good = good and all(type(count) is int and count > 0 for count in shape)
        if not good or math.prod(shape) > MOST_NODES:
            raise storage.StorageError(
                f"{where}: shape is {shape!r}; it must list {size} numbers of nodes, at most "
                f"{MOST_NODES:,} in all"
            )
        return ThreatTable(tuple(shape), actions)
    hidden = facts.get("hidden") if isinstance(facts, dict) else None
    if (
        not isinstance(hidden, list)
        or len(hidden) > DEEPEST
        or not all(type(width) is int and 0 < width <= WIDEST for width in hidden)
    ):
        raise storage.StorageError(
            f"{where}: hidden is {hidden!r}; it must list up to {DEEPEST} widths "
            f"of at most {WIDEST}"
        )
    if facts.get("activation") not in list(ACTIVATIONS):
        raise storage.StorageError(
            f"{where}: activation is {facts.get('activation')!r}; it must be one of "
            f"{sorted(ACTIVATIONS)}"
        )
    return ThreatNetwork(tuple(hidden), actions, facts["activation"])
