"""Structure of hazards and of their sources."""

from typing import Any

import jax
import numpy as np

from rp_jax.dynamics import num_threats
from rp_jax.envs.check.body_structure import draw_problems
from rp_jax.envs.check.problems import described, differences, plain
from rp_jax.envs.check.shapes import common_length, first_row, missing_methods, scalar, shape_of
from rp_jax.validate import shown

METHODS = {
    "draw": "(key, shape)",
    "step": "(hazard, body, noise)",
    "hits": "(body, hazard)",
    "in_reach": "(body, hazard)",
    "features": "(body, hazard)",
    "sample": "(key, model)",
    "state_of": "(features)",
}


def hazard_problems(subs: Any, groups: Any, body: Any, model: Any) -> list[str]:
    """Returns what is wrong with the structure of hazards and of the sub-R-MDPs.

    Args:
        subs: what `sub_rmdps` returns.
        groups: shapes of what `hazards` returns.
        body: shapes of the body's state.
        model: the body's model, `params.body`.
    """
    for name, value in (("sub_rmdps(params)", subs), ("hazards(state, params)", groups)):
        if not isinstance(value, dict):
            return [f"{name} is {type(value).__name__}; it must be a dict by kind of hazard"]
    found = []
    if set(subs) != set(groups):
        found.append(
            f"hazards(state, params) has the kinds {sorted(groups)} and sub_rmdps(params) has "
            f"{sorted(subs)}; both must have the same"
        )
    for kind in sorted(subs):
        found += _sub_problems(kind, subs[kind], model)
        hazard = None
        if kind in groups:
            hazard, problems = _group_problems(kind, groups[kind])
            found += problems
        if hazard is not None and hasattr(subs[kind], "source"):
            found += _source_problems(kind, subs[kind].source, model, body, hazard)
    return found


def _sub_problems(kind: str, sub: Any, model: Any) -> list[str]:
    found = [
        f"sub_rmdps(params)[{kind!r}] has no field `{field}`; it must be a SubRMDP"
        for field in ("body", "source", "beta")
        if not hasattr(sub, field)
    ]
    if found:
        return found
    beta = np.asarray(sub.beta)
    if beta.shape != () or not 0 < beta <= 1:
        found.append(f"beta of {kind!r} is {plain(sub.beta)}; it must be above 0 and at most 1")
    if sub.body is not model and num_threats(sub.body) != num_threats(model):
        found.append(
            f"the body of sub_rmdps(params)[{kind!r}] has {num_threats(sub.body)} threats and "
            f"params.body has {num_threats(model)}; both must have the same"
        )
    return found


def _group_problems(kind: str, group: Any) -> tuple[Any, list[str]]:
    """Shapes of one hazard of a kind, None if there is no telling, and what is wrong."""
    name = f"hazards(state, params)[{kind!r}]"
    lacking = [field for field in ("state", "present") if not hasattr(group, field)]
    if lacking:
        fields = " and ".join(f"`{field}`" for field in lacking)
        return None, [f"{name} has no field {fields}; it must be a Hazards"]
    count, found = common_length(f"{name}.state", group.state)
    if count is None:
        return None, found
    if group.present.shape != (count,) or group.present.dtype != bool:
        found.append(
            f"{name}.present is {described(group.present)}; it must be bool[{count}], as the "
            f"leading axis of its state is {count} long"
        )
    return first_row(group.state), found


def _source_problems(kind: str, source: Any, model: Any, body: Any, hazard: Any) -> list[str]:
    name = f"source of {kind!r}"
    found = _horizon_problems(name, source) + missing_methods(source, name, METHODS)
    if found:
        return found
    noise, found = draw_problems(f"draw of the {name}", source.draw)
    if noise is not None:
        moved, problems = shape_of(f"step of the {name}", source.step, hazard, body, noise)
        found += problems
        if moved is not None:
            found += differences(f"step of the {name}", moved, hazard)
    for method in ("hits", "in_reach"):
        what = f"{method} of the {name}"
        value, problems = shape_of(what, getattr(source, method), body, hazard)
        found += problems
        if value is not None:
            found += scalar(what, value, "bool")
    return found + _feature_problems(name, source, model, body, hazard)


def _horizon_problems(name: str, source: Any) -> list[str]:
    horizon = getattr(source, "horizon", None)
    if isinstance(horizon, int | np.integer) and not isinstance(horizon, bool) and horizon >= 1:
        return []
    return [f"horizon of the {name} is {shown(horizon)}; it must be an integer of at least 1"]


def _feature_problems(name: str, source: Any, model: Any, body: Any, hazard: Any) -> list[str]:
    features, found = shape_of(f"features of the {name}", source.features, body, hazard)
    if features is None:
        return found
    flat = getattr(features, "ndim", None) == 1 and features.shape[0] >= 1
    if not flat or not jax.dtypes.issubdtype(features.dtype, np.floating):
        shape = described(features)
        return [*found, f"features of the {name} are {shape}; they must be (F,) floats"]
    key, pair = jax.random.key(0), (body, hazard)
    for method, args in (("sample", (key, model)), ("state_of", (features,))):
        what = f"{method} of the {name}"
        drawn, problems = shape_of(what, getattr(source, method), *args)
        found += problems
        if drawn is not None:
            found += _pair_problems(what, drawn, pair)
    if hasattr(source, "mirrored"):
        several = jax.ShapeDtypeStruct((3, *features.shape), features.dtype)
        for given in (features, several):
            what = f"mirrored of the {name}"
            image, problems = shape_of(what, source.mirrored, given)
            found += problems
            if image is not None:
                found += differences(f"{what}, for {described(given)},", image, given)
            if problems:
                break
    return found


def _pair_problems(what: str, drawn: Any, pair: tuple[Any, Any]) -> list[str]:
    if not isinstance(drawn, tuple) or len(drawn) != 2:
        return [f"{what} returns {type(drawn).__name__}; it must return a body and a hazard"]
    found = differences(f"the body from {what}", drawn[0], pair[0])
    return found + differences(f"the hazard from {what}", drawn[1], pair[1])
