import jax
import jax.numpy as jnp
import numpy as np
from encounters import (
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
from rp_jax.envs import jam
from rp_jax.hazards import MovingObstacle


def test_an_obstacle_at_exactly_its_distance_is_not_hit():
    body = make_vehicle((0.0, 0.0), 0.0, 0.0)
    nearer = jnp.nextafter(jnp.float32(0.25), jnp.float32(0))
    params = jam.make_params()
    known = params.obstacle
    other = MovingObstacle.create(params.body, known.speeds, known.behaviour, distance=0.25)
    assert not other.hits(body, make_vehicle((0.0, 0.25), 1.0, 0.0))
    assert other.hits(body, make_vehicle((0.0, float(nearer)), 1.0, 0.0))


def test_samples_fill_the_window_and_hold_the_reachable_speeds():
    sub = sub_of(jam, "obstacle")
    bodies, others, features = drawn(sub, 8000)
    check_samples(sub.source, bodies, others, features, [bodies.speed, others.speed])
    check_speeds(features[:, 5], sub.body.speeds)
    check_speeds(features[:, 4], sub.source.speeds)


def test_state_of_inverts_features_of_any_pose(x64):
    features, again, _ = encounters(jam, "obstacle")
    np.testing.assert_allclose(again, features, atol=1e-12)


def test_state_of_makes_headings_of_any_length_unit_vectors():
    source = sub_of(jam, "obstacle").source
    _, other = source.state_of(jnp.asarray([0.1, 0.2, 1.5, -2.0, 0.02, 0.04]))
    np.testing.assert_allclose(other.heading, [0.6, -0.8], atol=1e-6)


def test_features_are_the_obstacle_in_the_frame_of_the_body_and_both_speeds():
    body = make_vehicle((1.0, 1.0), np.pi / 2, 0.04)
    other = make_vehicle((1.2, 1.0), 0.0, 0.06)  # to the right, and driving to the right
    found = jam.make_params().obstacle.features(body, other)
    np.testing.assert_allclose(found, [0.0, -0.2, 0.0, -1.0, 0.06, 0.04], atol=1e-6)


def test_mirrored_features_are_those_of_the_mirrored_situation():
    source = sub_of(jam, "obstacle").source
    body, other = make_vehicle((0.3, 0.2), 0.7, -0.02), make_vehicle((0.5, 0.9), 2.0, 0.04)
    expected = source.features(mirrored_by_hand(body), mirrored_by_hand(other))
    np.testing.assert_allclose(source.mirrored(source.features(body, other)), expected, atol=1e-6)


def test_mirrored_takes_batches():
    assert jam.make_params().obstacle.mirrored(jnp.ones((4, 6))).shape == (4, 6)


def test_mirrored_obstacles_threaten_the_mirrored_actions_alike(monte_carlo):
    sub = sub_of(jam, "obstacle")
    rng = np.random.default_rng(4)
    side, turn = rng.uniform(-np.pi, np.pi, (2, 150))
    away = rng.uniform(0.22, 0.6, 150)
    speeds = rng.choice([0.02, 0.04, 0.06], 150), rng.uniform(-0.1, 0.1, 150)
    columns = [away * np.cos(side), away * np.sin(side), np.cos(turn), np.sin(turn), *speeds]
    features = jnp.asarray(np.stack(columns, axis=-1), float)
    here = monte_carlo(jax.random.key(5), features, sub)
    there = monte_carlo(jax.random.key(6), jax.vmap(sub.source.mirrored)(features), sub)
    mirror = mirrored_actions(sub.body.actions)
    error = np.sqrt(np.square(here.stderr) + np.square(there.stderr[:, mirror]) + 1e-6)
    assert np.abs(there.threat[:, mirror] - here.threat).max() > 0  # other draws
    assert (np.abs(there.threat[:, mirror] - here.threat) < 5 * error).all()
    assert (np.abs(there.threat - here.threat) > 20 * error).any()


def test_the_vehicles_of_the_jam_and_of_its_sub_rmdps_move_alike_to_the_bit():
    params = params_of(jam, False)
    subs = jam.sub_rmdps(params)
    model, source = subs["obstacle"].body, subs["obstacle"].source
    bodies, actions = bodies_of(model, [[0.5, 0.5], [1.5, 2.0], [2.6, 2.9]])
    rng = np.random.default_rng(8)
    place, turn = rng.uniform(0.1, 2.9, (90, 8, 2)), rng.uniform(-3, 3, (90, 8))
    others = make_vehicle(place, turn, rng.uniform(0, 0.06, (90, 8)))
    states = jam.State(
        body=bodies,
        obstacles=others,
        present=jnp.ones((90, 8), bool),
        progress=jnp.zeros(90),
        time=jnp.zeros(90, jnp.int32),
    )
    controls = pick(source.behaviour.controls, rng.integers(15, size=(90, 8)))
    nowhere = jax.tree.map(lambda a: jnp.full_like(a, jnp.nan), others)
    draws = jam.Draws(controls=controls, relocated=nowhere)
    transition = jax.jit(jax.vmap(jam.transition, (0, 0, 0, None)))
    reached, _ = transition(states, actions, draws, params)

    alone = jax.jit(jax.vmap(model.step))(bodies, pick(model.actions, actions))
    same_bits(alone, reached.body)
    same_bits(subs["wall"].body, model)
    move = jax.jit(jax.vmap(jax.vmap(source.step, (0, None, 0))))
    alone = move(others, bodies, controls)
    stayed = ~np.isnan(np.asarray(reached.obstacles.speed))
    assert 0.5 < stayed.mean() < 1
    same_bits(pick(alone, stayed), pick(reached.obstacles, stayed))
