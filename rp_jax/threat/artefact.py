"""A learned threat function as a file of its own, to be used again with other x, tracks, counts."""

import dataclasses
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rp_jax import storage
from rp_jax.hazards import SubRMDP
from rp_jax.threat.model import ACTIVATIONS, DEEPEST, WIDEST, ThreatModel, ThreatNetwork

KIND = "threat function"


def save(
    folder: Path,
    environment: str,
    models: Mapping[str, ThreatModel],
    subs: Mapping[str, SubRMDP],
    about: Mapping[str, Any],
) -> None:
    """Saves the models of all kinds of hazard, with the sub-R-MDPs they hold for.

    Args:
        folder: created if missing.
        environment: name that `load` asks for again.
        models: by kind.
        subs: by kind.
        about: anything else worth keeping, such as reports.
    """
    networks = {
        kind: {"hidden": model.network.hidden, "activation": model.network.activation}
        for kind, model in models.items()
    }
    tree = {kind: {"model": models[kind], "sub": subs[kind]} for kind in models}
    statics = {kind: _statics(subs[kind]) for kind in models}
    facts = {"environment": environment, "networks": networks, "statics": statics, **about}
    storage.save(folder, KIND, tree, facts)


def load(folder: Path, environment: str, subs: Mapping[str, SubRMDP]) -> dict[str, ThreatModel]:
    """The models that `save` wrote.

    Raises:
        storage.StorageError: the file is damaged, or holds for another environment, other
            dynamics, another baseline policy or other hazards.
    """
    about = storage.read_manifest(folder, KIND)["about"]
    if about.get("environment") != environment:
        raise storage.StorageError(
            f"{folder}: environment is {about.get('environment')!r}; it must be {environment!r}"
        )
    networks = about.get("networks")
    if not isinstance(networks, dict) or set(networks) != set(subs):
        kinds = sorted(networks) if isinstance(networks, dict) else networks
        raise storage.StorageError(f"{folder}: hazards are {kinds}; they must be {sorted(subs)}")
    for kind, sub in subs.items():
        _same_statics(f"{folder}: {kind}", about.get("statics", {}), kind, sub)
    like = {
        kind: {"model": _blank(folder, kind, networks[kind], sub), "sub": sub}
        for kind, sub in subs.items()
    }
    tree = storage.load(folder, KIND, like)
    for kind, sub in subs.items():
        wanted, found = storage.leaves(sub), storage.leaves(tree[kind]["sub"])
        for name, value in wanted.items():
            if not np.allclose(value, found[name], rtol=1e-5, atol=1e-7):
                raise storage.StorageError(
                    f"{folder}: {kind}: {name} is {found[name].tolist()}; for this environment "
                    f"it must be {value.tolist()}"
                )
    return {kind: tree[kind]["model"] for kind in subs}


def _statics(part: Any, path: str = "") -> dict[str, str]:
    """What a tree of dataclasses holds that is no array (a horizon, a body's model), by path."""
    found: dict[str, str] = {}
    for field in dataclasses.fields(part) if dataclasses.is_dataclass(part) else ():
        value, name = getattr(part, field.name), path + field.name
        if field.metadata.get("pytree_node", True):
            found |= _statics(value, f"{name}/")
        else:
            found[name] = str(value)
    return found


def _same_statics(where: str, saved: Any, kind: str, sub: SubRMDP) -> None:
    """Raises StorageError if something differs that was saved; earlier versions saved nothing."""
    known = saved.get(kind, {}) if isinstance(saved, dict) else None
    if not isinstance(known, dict):
        raise storage.StorageError(f"{where}: statics is {known!r}; it must be a table")
    for name, value in _statics(sub).items():
        if (found := known.get(name, value)) != value:
            shown, wanted = (textwrap.shorten(str(text), 80) for text in (found, value))
            raise storage.StorageError(
                f"{where}: {name} is {shown}; for this environment it must be {wanted}"
            )


def _blank(folder: Path, kind: str, facts: Any, sub: SubRMDP) -> ThreatModel:
    """A model of the right structure, with the shapes of its weights."""
    hidden = facts.get("hidden") if isinstance(facts, dict) else None
    if (
        not isinstance(hidden, list)
        or len(hidden) > DEEPEST
        or not all(type(width) is int and 0 < width <= WIDEST for width in hidden)
    ):
        raise storage.StorageError(
            f"{folder}: {kind}: hidden is {hidden!r}; it must list up to {DEEPEST} widths "
            f"of at most {WIDEST}"
        )
    if facts.get("activation") not in list(ACTIVATIONS):
        raise storage.StorageError(
            f"{folder}: {kind}: activation is {facts.get('activation')!r}; it must be one of "
            f"{sorted(ACTIVATIONS)}"
        )
    network = ThreatNetwork(tuple(hidden), sub.agent.num_threats, facts["activation"])
    features = jax.eval_shape(
        lambda key: sub.source.features(*sub.source.sample(key, sub.agent)), jax.random.key(0)
    )
    shapes = jax.eval_shape(network.init, jax.random.key(0), features)
    return ThreatModel(sub.source, shapes, features, jnp.zeros(()), network)
