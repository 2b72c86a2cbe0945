import jax
import jax.numpy as jnp
import numpy as np
from encounters import directions, pick, same_bits, sequences

from rp_jax.dynamics import Vehicle, make_vehicle, mirrored_actions
from rp_jax.envs import point_gather
from rp_jax.hazards import Reach
from rp_jax.recon.labels import exact_threat


def bombs_of(horizon, rows):
    """(sub-R-MDP, bodies, bombs) drawn over the window."""
    sub = point_gather.sub_rmdps(point_gather.make_params(horizon=horizon))["bomb"]
    keys = jax.random.split(jax.random.key(2), rows)
    return sub, *jax.jit(jax.vmap(sub.source.sample, (0, None)))(keys, sub.body)


def quarter_turned(vector):
    return jnp.stack([-vector[..., 1], vector[..., 0]], axis=-1)


def test_bombs_and_their_bodies_are_drawn_all_over_the_room():
    _, bodies, bombs = bombs_of(15, 8000)
    for places in (bodies.position, bombs):
        share = (np.asarray(places) + 6) / 12
        quartiles = np.quantile(share, [0.25, 0.5, 0.75], axis=0).T
        assert (np.abs(quartiles - [0.25, 0.5, 0.75]) < 0.03).all()
    near, bodies, bombs = bombs_of(2, 8000)
    far = near.source.window.upper.max()
    assert far < 4
    assert (np.abs(bombs - bodies.position) <= far).all()
    assert (np.abs(bombs) <= 6).all()


def test_what_a_point_meets_within_the_horizon_lies_in_the_window(x64):
    sub, bodies, _ = bombs_of(4, 2000)
    rng = np.random.default_rng(0)
    chosen = sequences(rng, 2000, 4, 81)
    chosen[:500] = rng.choice([0, 4, 8, 72, 76, 80], (500, 1))  # whole steps
    controls = pick(sub.body.actions, chosen)
    rim = jnp.asarray(directions(rng, 2000))

    def meet(body, controls, rim):
        end, _ = jax.lax.scan(lambda v, c: (sub.body.step(v, c), None), body, controls)
        bomb = sub.source.centre(end) + (1 - 1e-9) * rim
        return sub.source.hits(end, bomb), sub.source.features(body, bomb)[:2]

    hit, relative = jax.jit(jax.vmap(meet))(bodies, controls, rim)
    assert hit.all()
    assert sub.source.window.contains(relative).all()
    assert relative[:, 0].max() > 0.9 * sub.source.window.upper[0]
    # Nobody turns that far in time: they slide along walls.
    reach = Reach.create(sub.body.replace(room=None), 4)
    free = reach.box(reach.limits[1]).upper[1] + 1 + point_gather.AHEAD
    assert np.abs(relative[:, 1]).max() > free


def test_a_bomb_is_hit_from_the_centre_of_mass_ahead_of_the_body():
    source = point_gather.make_params().bomb
    body = make_vehicle((1.0, 1.0), np.pi / 2, 0.0)
    for away, hit in ((1.04, True), (1.05, False)):
        assert source.hits(body, jnp.asarray([1.0, 1.0 + away])) == hit
        assert not source.hits(body, jnp.asarray([1.0, 1.0 - away]))


def test_a_bomb_s_features_name_it_and_the_room_from_the_body():
    source = point_gather.make_params().bomb
    body = make_vehicle((5.0, 2.0), np.pi / 2 + 0.1, 0.0)
    found = source.features(body.replace(heading=jnp.asarray([0.0, 1.0])), jnp.asarray([5.0, 5.0]))
    np.testing.assert_allclose(found, [3, 0, -2, 5, 1, 0], atol=1e-6)
    turned = source.features(body, jnp.asarray([5.0, 5.0]))
    np.testing.assert_allclose(turned[4:], [np.cos(0.4), np.sin(0.4)], atol=1e-6)


def test_situations_that_look_alike_from_the_sides_of_the_room_have_the_same_features(x64):
    sub, bodies, bombs = bombs_of(15, 200)
    features = jax.vmap(sub.source.features)
    found = features(bodies, bombs)
    turned = Vehicle(quarter_turned(bodies.position), quarter_turned(bodies.heading), bodies.speed)
    np.testing.assert_allclose(features(turned, quarter_turned(bombs)), found, atol=1e-12)
    again = features(*jax.vmap(sub.source.state_of)(found))
    np.testing.assert_allclose(again, found, atol=1e-12)
    flip = jnp.asarray([[1.0, -1.0]])
    mirrored = Vehicle(bodies.position * flip, bodies.heading * flip, bodies.speed)
    np.testing.assert_allclose(features(mirrored, bombs * flip), sub.source.mirrored(found), atol=0)


def test_mirrored_bombs_threaten_the_mirrored_actions_alike(x64):
    sub, bodies, bombs = bombs_of(2, 300)
    features = jax.vmap(sub.source.features)(bodies, bombs)
    close = jnp.argsort(jnp.linalg.norm(features[:, :2], axis=-1))[50:100]

    @jax.jit
    def threat(features):
        def one(row):
            return exact_threat(jax.random.key(0), *sub.source.state_of(row), sub).threat

        return jax.lax.map(one, features, batch_size=10)

    here = threat(features[close])
    there = threat(sub.source.mirrored(features[close]))
    assert ((here > 0.01) & (here < 0.9)).any()
    np.testing.assert_allclose(there[:, mirrored_actions(sub.body.actions)], here, atol=1e-9)


def test_the_body_of_point_gather_and_of_its_sub_rmdp_move_alike_to_the_bit():
    params = point_gather.make_params()
    sub, bodies, _ = bombs_of(15, 90)
    states = jax.vmap(point_gather.reset, (0, None))(
        jax.random.split(jax.random.key(0), 90), params
    )
    actions = jnp.arange(90) % 81
    step = jax.jit(jax.vmap(point_gather.step, (None, 0, 0, None)))
    reached, _ = step(jax.random.key(0), states.replace(body=bodies), actions, params)
    alone = jax.jit(jax.vmap(sub.body.step))(bodies, pick(sub.body.actions, actions))
    same_bits(alone, reached.body)
    assert (np.abs(alone.position) == 6).any()  # some come to a wall
