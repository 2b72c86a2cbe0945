"""Whether functions depend on their arguments alone, and what they return has its own memory."""

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
    key = trial.draws.keys(1)[0]
    start = trial.env.reset(typed(key), trial.params)
    first = _host(start)
    other = trial.env.reset(typed(key), trial.params)
    found = shared_memory("reset", start, trial.params, other) + _of_step(trial)
    again = first_difference(first, _host(other), "state", bits=True)
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
    reached = [step(*call) for call in calls]
    made = [_host(pair) for pair in reached]
    bits = jax.default_backend() == "cpu"  # elsewhere, sums may be taken in any order
    repeated = _differ(made[0], _host(step(*calls[0])), bits)
    found = shared_memory("step", reached[0][0], trial.params)
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


def shared_memory(what: str, state: Any, params: Any, other: Any = ()) -> list[str]:
    """Returns what says that a state's arrays are also elsewhere, or twice in the state.

    Args:
        what: the function that returned the state, for the sentence.
        state: a state, from a function that was not compiled.
        params: the parameters that the function was given.
        other: another state, from another call of the function.
    """
    names = {place: f"another state{path}" for path, place in _places(other)}
    names |= {place: f"params{path}" for path, place in _places(params)}
    for path, place in _places(state):
        if place in names:
            return [
                f"{what}: state{path} and {names[place]} are one array; state{path} must be a copy "
                "(jnp.copy), since whoever gives a state's memory away (donate_argnums of jax.jit) "
                "gives both away"
            ]
        names[place] = f"state{path}"
    return []


def _places(tree: Any) -> list[tuple[str, int]]:
    """Returns where the arrays of a pytree lie in memory."""
    leaves = [
        (jax.tree_util.keystr(path), leaf)
        for path, leaf in jax.tree_util.tree_flatten_with_path(frozen(tree))[0]
        if isinstance(leaf, jax.Array) and leaf.size
    ]
    return [(path, leaf.unsafe_buffer_pointer()) for path, leaf in leaves]


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
