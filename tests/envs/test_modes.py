"""Every environment in the modes of JAX: traced, strict about types, nan and infinity as errors.

As a script it makes a step in the environments named, to be run under other settings of JAX.
"""

import functools
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from examples.crossing import world as crossing
from examples.drone import world as drone
from examples.trolley import world as trolley
from rp_jax.dynamics import Plans
from rp_jax.envs import circuit, jam, optional, patrol, point_gather

ROOT = Path(__file__).parents[2]
PLANS = {"baseline": "plans"}
PAPER = {"fidelity": "paper"}
WORLDS = {
    "circuit": (circuit, {}),
    "circuit-plans": (circuit, PLANS),
    "circuit-paper": (circuit, PAPER),
    "jam": (jam, {}),
    "jam-plans": (jam, PLANS),
    "jam-paper": (jam, PAPER),
    "patrol": (patrol, {}),
    "point_gather": (point_gather, {}),
    "crossing": (crossing, {}),
    "drone": (drone, {}),
    "trolley": (trolley, {}),
}
every_world = pytest.mark.parametrize("name", WORLDS)


@functools.lru_cache
def made(name):
    env, settings = WORLDS[name]
    return env, env.make_params(**settings)


def play(env, params):
    """Returns all that is computed in one step from a start."""
    key = jax.random.key(0)
    state = env.reset(key, params)
    reached, outcome = env.step(key, state, jnp.asarray(1, jnp.int32), params)
    told = env.hazards(reached, params), optional.collisions(env, reached, params)
    return state, reached, outcome, env.observe(reached, params), told


def rest(env, params):
    """Returns what some environments have beside that."""
    state, found = env.reset(jax.random.key(0), params), []
    if hasattr(params.body, "speeds"):  # it takes continuous actions as well
        action = jnp.asarray([0.5, -0.5], float)
        found += [env.step(jax.random.key(0), state, action, params)]
    if isinstance(params.body.baseline, Plans):
        found += [env.clearance(state.body.position, params)]
    return found


@every_world
def test_parameters_can_be_made_while_a_function_is_traced(name):
    (env, params), settings = made(name), WORLDS[name][1]
    inside = jax.jit(lambda: env.make_params(**settings))()
    assert jax.tree.structure(inside) == jax.tree.structure(params)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-6), inside, params)
    key = jax.random.key(0)
    start = jax.eval_shape(lambda key: env.reset(key, env.make_params(**settings)), key)
    assert str(start) == str(jax.eval_shape(env.reset, key, params))


@every_world
def test_no_type_has_to_be_promoted(name):
    env, settings = WORLDS[name]
    both = lambda params: (play(env, params), rest(env, params))  # noqa: E731
    expected = jax.eval_shape(both, made(name)[1])
    with jax.numpy_dtype_promotion("strict"):
        found = jax.eval_shape(both, env.make_params(**settings))
    assert str(found) == str(expected)


@pytest.mark.parametrize(
    "names",
    ["jam patrol point_gather", pytest.param("circuit crossing drone", marks=pytest.mark.slow)],
)
def test_nothing_computed_is_nan_or_infinite_where_these_are_errors(names):
    settings = {"JAX_DEBUG_NANS": "1", "JAX_DEBUG_INFS": "1", "PYTHONPATH": str(ROOT)}
    settings |= {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}  # compiled sooner
    command = [sys.executable, __file__, *names.split()]
    done = subprocess.run(command, env=os.environ | settings, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


if __name__ == "__main__":  # without compilation of the whole, so that all is looked at
    for argument in sys.argv[1:]:
        play(*made(argument))
