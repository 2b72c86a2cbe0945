import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax.dynamics import make_vehicle
from rp_jax.envs import jam, patrol

COAST = 7
step = jax.jit(patrol.step)


@pytest.fixture(scope="module")
def params():
    return patrol.make_params(3)


def at(params, position, aim=0, speed=0.1, heading=0.0):
    """A state in which the agent is at a place, far from the obstacles' corner."""
    others = jax.vmap(make_vehicle, (0, None, None))(jnp.full((3, 2), 1.5), 0.0, 0.0)
    state = jam.start_at(make_vehicle(position, heading, speed), others, params)
    fields = {f.name: getattr(state, f.name) for f in dataclasses.fields(jam.State)}
    return patrol.State(**fields, aim=jnp.asarray(aim, jnp.int32))


def test_way_made_towards_the_corner_is_earned(params):
    state = at(params, (1.0, 2.75), heading=np.pi)
    _, outcome = step(jax.random.key(0), state, COAST, params)
    assert outcome.reward == pytest.approx(20 * 0.1 - 0.05, abs=1e-4)
    _, outcome = step(
        jax.random.key(0), state.replace(aim=jnp.asarray(1, jnp.int32)), COAST, params
    )
    way = np.hypot(1.75, 2.5) - np.hypot(1.85, 2.5)
    assert outcome.reward == pytest.approx(20 * way - 0.05, abs=1e-3)


@pytest.mark.parametrize("aim", [0, 1])
def test_at_a_corner_the_other_one_is_next(aim, params):
    place = np.add(patrol.CORNERS[aim], (0.3 if aim == 0 else -0.3, 0.0))
    state = at(params, place, aim, heading=np.pi * (1 - aim))
    reached, outcome = step(jax.random.key(0), state, COAST, params)
    assert reached.aim == 1 - aim
    assert outcome.reward == pytest.approx(20 * 0.1 - 0.05 + 10, abs=1e-4)
    assert not outcome.done


def test_all_else_is_as_in_jam(params):
    key = jax.random.key(1)
    state = patrol.reset(key, params)
    plain = jam.reset(key, params)

    @jax.jit  # one program: two may round differently
    def both(action):
        return patrol.step(key, state, action, params), jam.step(key, plain, action, params)

    for action in (0, 7, 14):
        (mine, outcome), (theirs, expected) = both(action)
        for field in dataclasses.fields(jam.State):
            jax.tree.map(
                np.testing.assert_array_equal,
                getattr(mine, field.name),
                getattr(theirs, field.name),
            )
        assert outcome.danger == expected.danger
        assert outcome.terminated == expected.terminated
    seen = patrol.observe(state.replace(aim=jnp.asarray(1, jnp.int32)), params)
    np.testing.assert_array_equal(seen[:-1], jam.observe(plain, params))
    assert seen[-1] == 1
    assert patrol.LIDAR_BINS + len(patrol.SCALE) == len(seen)


def test_the_exit_ends_the_patrol_and_earns_nothing(params):
    state = at(params, (2.6, 2.95), aim=0, heading=np.pi / 2)
    _, outcome = step(jax.random.key(0), state, COAST, params)
    assert outcome.terminated
    assert not outcome.goal
    assert outcome.danger == 0
    assert outcome.reward < 0
