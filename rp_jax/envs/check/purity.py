"""Whether functions depend on their arguments alone."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rp_jax.envs.check.batches import frozen, take, typed
from rp_jax.envs.check.comparison import first_difference
from rp_jax.envs.check.trial import Trial


def impurities(trial: Trial) -> list[str]:
    """Returns what says that `reset` or `step` is no pure function.

    The functions run without compilation, which takes long: few calls are made.

    Args:
        trial: the environment.
    """
    key = typed(trial.draws.keys(1)[0])
    first = _host(trial.env.reset(key, trial.params))
    found = _of_step(trial)
    again = first_difference(first, _host(trial.env.reset(key, trial.params)), "state", bits=True)
    if again is not None:
        found.append(
            f"reset is not pure: for the same key, {again}; it must depend on its arguments alone"
        )
    return found


def _of_step(trial: Trial) -> list[str]:
    steps, step = trial.steps, trial.env.step
    rows = trial.draws.among(np.arange(len(steps.action)), 2)
    calls = [_call(trial, row) for row in rows]
    given = [_host(state) for _, state, _, _ in calls]
    made = [_host(step(*call)) for call in calls]
    bits = jax.default_backend() == "cpu"  # elsewhere, sums may be taken in any order
    repeated = _differ(made[0], _host(step(*calls[0])), bits)
    found = []
    for (_, state, _, _), saved in zip(calls, given, strict=True):
        changed = first_difference(saved, _host(state), "state", bits=True)
        if changed is not None:
            found.append(
                f"step changes the state that it is given: {changed} before and after the call; "
                "it must return a new state"
            )
            break
    if repeated is not None:
        found.append(
            f"step is not pure: for the same key, state and action, {repeated}; it must depend on "
            "its arguments alone"
        )
        return found
    compiled = [(take(steps.reached, row), take(steps.outcome, row)) for row in rows]
    unlike = [_differ(*pair, bits=False) for pair in zip(made, compiled, strict=True)]
    if all(unlike):  # a single one may be a threshold that rounding has turned over
        found.append(
            f"step gives something else when it is compiled: {unlike[0]}, without jax.jit and with "
            "it; both must be the same up to rounding"
        )
    return found


def _call(trial: Trial, row: int) -> tuple[Any, Any, Any, Any]:
    """The arguments of a step that was made."""
    steps = trial.steps
    key = jax.random.split(typed(steps.keys[row]))[0]
    state = trial.thaw(jax.tree.map(jnp.asarray, take(steps.before, row)))
    return key, state, jnp.asarray(steps.action[row]), trial.params


def _differ(a: Any, b: Any, bits: bool) -> str | None:
    names = ("state", "outcome")
    texts = (first_difference(x, y, name, bits) for name, x, y in zip(names, a, b, strict=True))
    return next(filter(None, texts), None)


def _host(tree: Any) -> Any:
    """A copy on the host, so that what changes later is noticed."""
    return jax.tree.map(lambda a: np.array(a), frozen(tree))
