"""Structure of an environment: its functions, and the shapes of what they return."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rp_jax.dynamics import Plans
from rp_jax.envs import optional
from rp_jax.envs.check.body_structure import action_problems, body_problems, mirror_problems
from rp_jax.envs.check.hazard_structure import hazard_problems
from rp_jax.envs.check.problems import described, differences, plain, trouble
from rp_jax.envs.check.shapes import scalar, shape_of
from rp_jax.envs.contract import FUNCTIONS
from rp_jax.validate import shown

OPTIONAL = (
    "num_actions",
    "collisions",
    "clearance",
    "threshold",
    "make_params",
    "mixed_start",
    "without_moving_hazards",
)
OUTCOME = {
    "reward": "floating",
    "danger": "floating",
    "terminated": "bool",
    "truncated": "bool",
    "goal": "bool",
    "done": "bool",
}


def contract_problems(env: Any, params: Any) -> list[str]:
    """Returns what is wrong with the structure of an environment, one sentence each.

    Args:
        env: the environment.
        params: its parameters.
    """
    found = _missing(env, params)
    if found:
        return found
    key = jax.random.key(0)
    state, found = shape_of("reset", env.reset, key, params)
    if state is None:
        return found
    found = _state_problems(state) + _limit_problems(params)
    if not hasattr(state, "body"):
        return found
    of_body = body_problems(params.body, state.body)
    found += of_body if of_body else _action_problems(env, params)
    found += _step_problems(env, params, key, state) + _observation_problems(env, params, state)
    return found + _hazard_problems(env, params, state)


def _missing(env: Any, params: Any) -> list[str]:
    found = [
        f"the environment has no function `{name}`; it must have {name}{arguments}"
        for name, arguments in FUNCTIONS.items()
        if not callable(getattr(env, name, None))
    ]
    found += [
        f"{name} of the environment is {shown(getattr(env, name))}; it must be a function, or be "
        "left out"
        for name in OPTIONAL
        if hasattr(env, name) and not callable(getattr(env, name))
    ]
    found += [
        f"params has no field `{field}`; it must have one"
        for field in ("body", "time_limit")
        if not hasattr(params, field)
    ]
    planned = isinstance(getattr(getattr(params, "body", None), "baseline", None), Plans)
    if planned and not hasattr(env, "clearance"):
        found.append(
            "the environment has no function `clearance` although params.body.baseline is Plans; "
            "it must have clearance(position, params), infinite where nothing is fixed"
        )
    return found


def _state_problems(state: Any) -> list[str]:
    found = [
        f"the state has no field `{field}`; it must have one"
        for field in ("body", "time")
        if not hasattr(state, field)
    ]
    if hasattr(state, "time"):
        found += scalar("state.time", state.time, "integer")
    return found


def _limit_problems(params: Any) -> list[str]:
    limit = np.asarray(params.time_limit)
    if limit.shape == () and np.issubdtype(limit.dtype, np.integer) and limit >= 1:
        return []
    return [f"params.time_limit is {plain(params.time_limit)}; it must be a () integer, at least 1"]


def _action_problems(env: Any, params: Any) -> list[str]:
    try:
        actions = optional.num_actions(env, params)
    except Exception as error:
        return [f"num_actions raises {trouble(error)}"]
    return action_problems(params.body, actions)


def _step_problems(env: Any, params: Any, key: Any, state: Any) -> list[str]:
    action = jnp.asarray(0, jnp.int32)
    stepped, found = shape_of("step", env.step, key, state, action, params)
    if stepped is None:
        return found
    if not isinstance(stepped, tuple) or len(stepped) != 2:
        return [f"step returns {type(stepped).__name__}; it must return (state, outcome)"]
    changed = differences("state", stepped[0], state)
    found += [f"step changes the state's structure, shape or type: {change}" for change in changed]

    def fields(*args: Any) -> dict[str, Any]:
        outcome = env.step(*args)[1]
        return {field: getattr(outcome, field) for field in OUTCOME if hasattr(outcome, field)}

    outcome, problems = shape_of("the outcome of step", fields, key, state, action, params)
    for field, kind in OUTCOME.items() if outcome is not None else ():
        if field not in outcome:
            found.append(f"the outcome of step has no field `{field}`; it must be an Outcome")
        else:
            found += scalar(f"outcome.{field} of step", outcome[field], kind)
    return found + problems


def _observation_problems(env: Any, params: Any, state: Any) -> list[str]:
    seen, found = shape_of("observe", env.observe, state, params)
    if seen is None:
        return found
    if hasattr(env, "threshold"):
        number = jax.ShapeDtypeStruct((), jax.dtypes.canonicalize_dtype(float))
        x, problems = shape_of("threshold", env.threshold, state, number, number)
        found += problems or scalar("threshold(state, x, least)", x, "floating")
    flat = getattr(seen, "ndim", None) == 1 and seen.shape[0] >= 1
    if not flat or not jnp.issubdtype(seen.dtype, jnp.floating):
        text = described(seen) if hasattr(seen, "dtype") else type(seen).__name__
        return [f"observe returns {text}; it must return a flat array of floats"]
    size, bins = seen.shape[0], optional.lidar_bins(env)
    try:
        scale = optional.scale(env)
    except (TypeError, ValueError):
        return [*found, f"SCALE is {shown(env.SCALE)}; it must be a tuple of numbers, or left out"]
    whole = isinstance(bins, int | np.integer) and not isinstance(bins, bool)
    if not whole or bins < 0 or bins % 8 or bins > size:
        return [
            f"LIDAR_BINS is {shown(bins)}; it must be a multiple of 8, and at most the length of "
            f"the observation, which is {size}"
        ]
    if len(scale) and len(scale) != size - bins:
        found.append(
            f"SCALE has the length {len(scale)}; it must be {size - bins}, the length of the "
            f"observation ({size}) without the LIDAR ({bins}), or be left out"
        )
    if not all(math.isfinite(factor) for factor in scale):
        found.append(f"SCALE is {shown(scale)}; its factors must be finite")
    return found


def _hazard_problems(env: Any, params: Any, state: Any) -> list[str]:
    try:
        subs = env.sub_rmdps(params)
    except Exception as error:
        return [f"sub_rmdps raises {trouble(error)}"]
    groups, found = shape_of("hazards", env.hazards, state, params)
    if groups is None:
        return found
    found += hazard_problems(subs, groups, state.body, params.body)
    sources = [getattr(sub, "source", None) for sub in subs.values()] if not found else []
    if not found:
        mirrored = any(hasattr(source, "mirrored") for source in sources)
        found += mirror_problems(params.body, mirrored)
        found += _collision_problems(env, params, state, set(subs))
        found += _clearance_problems(env, params)
    return found


def _collision_problems(env: Any, params: Any, state: Any, kinds: set[str]) -> list[str]:
    if not hasattr(env, "collisions"):
        return []
    hit, found = shape_of("collisions", env.collisions, state, params)
    if hit is None:
        return found
    if not isinstance(hit, dict) or not set(hit) >= kinds:
        value = sorted(hit) if isinstance(hit, dict) else type(hit).__name__
        return [f"collisions has {value}; it must be a dict with all the kinds {sorted(kinds)}"]
    for kind, leaf in hit.items():
        found += scalar(f"collisions of {kind!r}", leaf, "bool")
    return found


def _clearance_problems(env: Any, params: Any) -> list[str]:
    if not isinstance(params.body.baseline, Plans):
        return []  # it is asked for under plans only
    position = jnp.zeros(2)
    left, found = shape_of("clearance", env.clearance, position, params)
    return found if left is None else found + scalar("clearance", left, "floating")
