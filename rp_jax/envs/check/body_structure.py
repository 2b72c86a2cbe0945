"""Structure of a body's model: its table of actions, its steps and its baseline policy."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rp_jax.dynamics import ControlDistribution, Plans, VehicleModel, num_threats
from rp_jax.envs.check.problems import described, differences, trouble
from rp_jax.envs.check.shapes import (
    common_length,
    first_row,
    missing_methods,
    shape_of,
    with_leading,
)

METHODS = {"control": "(action)", "step": "(body, control)"}
POLICY = {"draw": "(key, shape)", "act": "(body, noise)"}


def body_problems(model: Any, body: Any) -> list[str]:
    """Returns what is wrong with the shapes of a body's model.

    Args:
        model: the body's model, `params.body`.
        body: shapes of the body's state.
    """
    found = missing_methods(model, "params.body", METHODS)
    found += [
        f"params.body has no field `{field}`; it must have one"
        for field in ("actions", "baseline")
        if not hasattr(model, field)
    ]
    if found:
        return found
    count, found = common_length("params.body.actions", model.actions)
    if count is None:
        return found
    control, problems = shape_of("params.body.control", model.control, jnp.asarray(0, jnp.int32))
    if control is None:
        return problems
    found += differences("params.body.control(action)", control, first_row(model.actions))
    moved, problems = shape_of("params.body.step", model.step, body, control)
    found += problems
    if moved is not None:
        found += differences("params.body.step(body, control)", moved, body)
    if isinstance(model.baseline, Plans):
        return found + _plan_problems(model.baseline, body, control)
    return found + _policy_problems(model.baseline, body, control)


def _plan_problems(plans: Plans, body: Any, control: Any) -> list[str]:
    found = [
        f"state.body.{field} is {described(getattr(body, field, None))}; plans need an array of "
        f"shape {shape}"
        for field, shape in (("position", (2,)), ("speed", ()))
        if getattr(getattr(body, field, None), "shape", None) != shape
    ]
    if found:
        return found
    first = jax.tree.map(
        lambda a: a[0], plans.replace(max_acceleration=plans.max_acceleration[None])
    )
    given, problems = shape_of("params.body.baseline.control", first.control, 0, body.speed)
    if given is None:
        return problems
    return differences("params.body.baseline.control(k, speed)", given, control)


def _policy_problems(policy: Any, body: Any, control: Any) -> list[str]:
    found = missing_methods(policy, "params.body.baseline", POLICY)
    if found:
        return found
    noise, found = draw_problems("params.body.baseline.draw", policy.draw)
    if noise is None:
        return found
    given, problems = shape_of("params.body.baseline.act", policy.act, body, noise)
    found += problems
    if given is not None:
        found += differences("params.body.baseline.act(body, noise)", given, control)
    if isinstance(policy, ControlDistribution):
        found += _probability_problems(policy)
    return found


def draw_problems(what: str, draw: Any) -> tuple[Any, list[str]]:
    """Returns the shapes of the random numbers of one step, and what is wrong with the draw.

    Args:
        what: the method, for the sentence.
        draw: the method; its arguments are a key and a shape.
    """
    key = jax.random.key(0)
    one, found = shape_of(what, draw, key)
    if one is None:
        return None, found
    for shape in ((3,), (2, 3)):
        several, problems = shape_of(f"{what} of shape {shape}", lambda k, s=shape: draw(k, s), key)
        found += problems
        if several is not None:
            found += differences(f"{what}(key, {shape})", several, with_leading(shape, one))
        if found:
            break
    return one, found


def _probability_problems(policy: ControlDistribution) -> list[str]:
    chances = np.asarray(policy.probabilities, float)
    count, found = common_length("params.body.baseline.controls", policy.controls)
    if count is not None and chances.shape != (count,):
        found.append(
            f"params.body.baseline.probabilities has the shape {chances.shape}; it must be "
            f"({count},), one for each of the controls"
        )
    if not (chances >= 0).all() or not abs(chances.sum() - 1) < 1e-4:
        found.append(
            f"params.body.baseline.probabilities sum to {chances.sum():.6g} and the least is "
            f"{chances.min():.6g}; they must be at least 0 and sum to 1"
        )
    return found


def action_problems(model: Any, actions: Any) -> list[str]:
    """Returns a sentence if the number of actions is not that of the table's rows.

    Args:
        model: the body's model, which has a table of actions.
        actions: the environment's number of actions.
    """
    rows = common_length("", model.actions)[0]
    integer = isinstance(actions, int | np.integer) and not isinstance(actions, bool)
    if integer and actions == rows:
        return []
    return [
        f"num_actions(params) is {described(actions)}; it must be {rows}, the number of rows of "
        "params.body.actions"
    ]


def mirror_problems(model: Any, mirrored: bool) -> list[str]:
    """Returns what is wrong with the left-right mirror images of a body's actions.

    Args:
        model: the body's model.
        mirrored: whether features of some hazards can be mirrored.
    """
    if not hasattr(model, "mirrored_threats"):
        if not mirrored:
            return []
        return [
            "params.body has no `mirrored_threats` although a hazard source has `mirrored`; a "
            "left-right symmetry needs both"
        ]
    try:
        images = np.asarray(model.mirrored_threats())
    except ValueError as error:  # there is no such symmetry, and none may be claimed
        if not mirrored:
            return []
        return [
            f"params.body.mirrored_threats raises {trouble(error)}, although a hazard source has "
            "`mirrored`; a left-right symmetry needs both"
        ]
    except Exception as error:
        return [f"params.body.mirrored_threats raises {trouble(error)}"]
    count = num_threats(model)
    if images.shape != (count,) or not np.array_equal(np.sort(images), np.arange(count)):
        return [
            f"params.body.mirrored_threats() is {images.tolist()[:20]} of shape {images.shape}; it "
            f"must be a permutation of 0, ..., {count - 1}"
        ]
    if not np.array_equal(images[images], np.arange(count)):
        first = int(np.argmax(images[images] != np.arange(count)))
        return [
            f"params.body.mirrored_threats() takes {first} to {images[first]} and that to "
            f"{images[images[first]]}; the mirror image of a mirror image must be the original"
        ]
    own = getattr(type(model), "mirrored_threats", None) is not VehicleModel.mirrored_threats
    if own and not mirrored and not np.array_equal(images, np.arange(count)):
        return [
            "params.body has `mirrored_threats` although no hazard source has `mirrored`; a "
            "left-right symmetry needs both"
        ]
    return []
