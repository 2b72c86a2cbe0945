import jax
import jax.numpy as jnp
import numpy as np
import pytest
from encounters import (
    SPEEDS,
    bodies_of,
    check_samples,
    check_speeds,
    drawn,
    encounters,
    mirrored_by_hand,
    params_of,
    pick,
    same_bits,
    sub_of,
)

from rp_jax.dynamics import make_vehicle, mirrored_actions
from rp_jax.envs import circuit, jam
from rp_jax.hazards import WallPoint

each_room = pytest.mark.parametrize("env", [circuit, jam])


def test_a_wall_at_exactly_its_radius_is_not_hit():
    body = make_vehicle((0.0, 0.0), 0.0, 0.0)
    nearer = jnp.nextafter(jnp.float32(0.25), jnp.float32(0))
    wall = WallPoint.create(jam.make_params().body, radius=0.25)
    assert not wall.hits(body, jnp.asarray([0.25, 0.0]))
    assert wall.hits(body, jnp.stack([nearer, jnp.float32(0)]))


def test_samples_fill_the_window_and_hold_the_reachable_speeds():
    sub = sub_of(circuit, "wall")
    bodies, points, features = drawn(sub, 8000)
    check_samples(sub.source, bodies, points, features, [bodies.speed])
    check_speeds(features[:, 2], sub.body.speeds)


@each_room
def test_state_of_inverts_features_of_any_pose(env, x64):
    features, again, _ = encounters(env, "wall")
    np.testing.assert_allclose(again, features, atol=1e-12)


def test_features_are_the_point_in_the_frame_of_the_body_and_its_speed():
    body = make_vehicle((1.0, 1.0), np.pi / 2, 0.04)
    found = jam.make_params().wall.features(body, jnp.asarray([0.9, 1.3]))
    np.testing.assert_allclose(found, [0.3, 0.1, 0.04], atol=1e-6)


@each_room
def test_mirrored_features_are_those_of_the_mirrored_situation(env):
    source = sub_of(env, "wall").source
    body, point = make_vehicle((0.3, 0.2), 0.7, -0.02), jnp.asarray([0.5, 0.9])
    expected = source.features(mirrored_by_hand(body), point * jnp.asarray([1.0, -1.0]))
    np.testing.assert_allclose(source.mirrored(source.features(body, point)), expected, atol=1e-6)


def test_mirrored_takes_batches():
    assert jam.make_params().wall.mirrored(jnp.ones((4, 3))).shape == (4, 3)


@each_room
def test_mirrored_walls_threaten_the_mirrored_actions_alike(env, exact, x64):
    sub = sub_of(env, "wall")
    rng = np.random.default_rng(3)
    columns = [rng.uniform(-0.2, 0.5, 250), rng.uniform(-0.3, 0.3, 250), rng.choice(SPEEDS, 250)]
    features = jnp.asarray(np.stack(columns, axis=-1))
    here = exact(features, sub).threat
    there = exact(jax.vmap(sub.source.mirrored)(features), sub).threat
    assert (here > 0.01).any(axis=1).mean() > 0.2
    assert not np.allclose(here, there, atol=1e-3)
    np.testing.assert_allclose(there[:, mirrored_actions(sub.body.actions)], here, atol=1e-9)


def test_the_body_of_the_circuit_and_of_its_sub_rmdp_move_alike_to_the_bit():
    params = params_of(circuit, False)
    model = circuit.sub_rmdps(params)["wall"].body
    bodies, actions = bodies_of(model, params.track.centre)
    zero = jnp.zeros(90, jnp.int32)
    states = circuit.State(body=bodies, index=zero, time=zero, hide_position=zero > 0)
    step = jax.jit(jax.vmap(circuit.step, (None, 0, 0, None)))
    reached, _ = step(jax.random.key(0), states, actions, params)
    alone = jax.jit(jax.vmap(model.step))(bodies, pick(model.actions, actions))
    same_bits(alone, reached.body)
