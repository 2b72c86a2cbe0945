import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401

from examples.drone import world
from examples.drone.world import Motion
from rp_jax.envs import check, optional
from rp_jax.threat.function import ThreatFunction, load_threat
from rp_jax.threat.model import ThreatModel, ThreatNetwork

KINDS = ["disc", "pylon", "wall"]
PAIRS = 4096
every_kind = pytest.mark.parametrize("kind", KINDS)
PUSH = 8  # index of the action that accelerates most along x and y


@functools.lru_cache
def params():
    return world.make_params()


def motion(position, velocity=(0.0, 0.0)):
    return Motion(jnp.asarray(position, float), jnp.asarray(velocity, float))


def start(position, velocity=(0.0, 0.0), **others):
    """A start whose drone, and whose obstacles of some kinds, are moved elsewhere."""
    state = world.reset(jax.random.key(0), params())
    return state.replace(body=motion(position, velocity), obstacles={**state.obstacles, **others})


@functools.lru_cache
def jitted_step():
    return jax.jit(world.step)


def step(state, action):
    return jitted_step()(jax.random.key(1), state, jnp.asarray(action), params())


def far_discs(**moved):
    """Ten discs that stand in a corner, and some of them, by index, elsewhere."""
    position, velocity = np.full((10, 2), (3.9, 1.9)), np.zeros((10, 2))
    for name, (where, way) in moved.items():
        position[int(name[1:])], velocity[int(name[1:])] = where, way
    return motion(position, velocity)


# --- the drone ---


@pytest.mark.parametrize(
    ("velocity", "action", "after"),
    [
        ((0.0, 0.0), 4, (0.0, 0.0)),
        ((0.0, 0.0), 8, (0.025, 0.025)),
        ((0.05, -0.05), 0, (0.025, -0.075)),
        ((0.09, 0.0), 7, (0.1, 0.0)),  # no faster than the top speed
        ((-0.1, 0.1), 2, (-0.1, 0.1)),
        ((-0.1, 0.1), 6, (-0.075, 0.075)),
    ],
)
def test_the_drone_moves_at_its_old_velocity_and_then_accelerates(velocity, action, after):
    model = params().body
    moved = model.step(motion((1.0, 2.0), velocity), model.control(jnp.asarray(action)))
    np.testing.assert_allclose(moved.position, np.add((1.0, 2.0), velocity), rtol=1e-6)
    np.testing.assert_allclose(moved.velocity, after, atol=1e-7)


def braked(velocity, noise):
    """Drones (n, 2) that brake as strongly as `noise` (steps, n) says: controls and velocities."""
    model = params().body

    def brake(body, noise):
        control = jax.vmap(model.baseline.act)(body, noise)
        moved = jax.vmap(model.step)(body, control)
        return moved, (control, moved)

    body = Motion(jnp.zeros_like(velocity), velocity)
    return jax.device_get(jax.jit(functools.partial(jax.lax.scan, brake))(body, noise)[1])


def test_the_baseline_policy_brakes_to_a_halt_and_never_reverses():
    velocity = jax.random.uniform(jax.random.key(0), (1000, 2), float, -0.1, 0.1)
    noise = params().body.baseline.draw(jax.random.key(1), (7, 1000))
    assert noise.shape == (7, 1000)
    assert 0.7 * 0.025 <= noise.min() < 0.72 * 0.025
    assert 0.99 * 0.025 < noise.max() <= 0.025
    controls, moved = braked(velocity, noise)
    ways = np.concatenate([np.asarray(velocity)[None], moved.velocity])
    assert np.abs(controls).max() <= world.ACCELERATION
    assert (ways[1:] * ways[:-1] >= 0).all()  # no axis changes its sign
    slower = np.maximum(np.abs(ways[:-1]) - 0.7 * world.ACCELERATION, 0)
    assert (np.abs(ways[1:]) <= slower + 1e-7).all()
    np.testing.assert_allclose(ways[6:], 0, atol=1e-7)  # .1 / (.7 * .025) is less than 6
    assert params().sources["disc"].horizon > 1 + 6  # it stands before threats end


def test_the_baseline_policy_brakes_as_strongly_as_is_drawn():
    noise = jnp.asarray([0.025, 0.02, 0.025, 0.02, 0.025, 0.02])[:, None]
    controls, moved = braked(jnp.asarray([[0.1, -0.03]]), noise)
    left = [[0.075, -0.005], [0.055, 0], [0.03, 0], [0.01, 0], [0, 0], [0, 0]]
    np.testing.assert_allclose(moved.velocity[:, 0], left, atol=1e-7)
    np.testing.assert_allclose(controls[1, 0], [-0.02, 0.005], atol=1e-7)
    np.testing.assert_allclose(moved.position[-1, 0], [0.27, -0.035], atol=1e-6)


# --- the hazards ---


@pytest.mark.parametrize(
    ("kind", "place", "hit"),
    [
        ("disc", (0.11, 0.0), True),
        ("disc", (-0.09, 0.09), False),
        ("disc", (-0.08, 0.08), True),
        ("pylon", (0.0, -0.099), True),
        ("pylon", (0.0, -0.101), False),
        ("wall", (3.0, -0.09), True),  # a wall is hit wherever along it
        ("wall", (-7.0, 0.09), True),
        ("wall", (0.0, -0.11), False),
    ],
)
def test_a_hazard_is_hit_from_nearer_than_its_radius(kind, place, hit):
    body = motion((1.0, 1.0))
    hazard = motion(np.add((1.0, 1.0), place))
    assert params().sources[kind].hits(body, hazard) == hit


def test_a_disc_drifts_with_small_changes_up_to_its_top_speed_and_the_others_stand():
    for kind, source in params().sources.items():
        noise = source.draw(jax.random.key(0), (500,))
        hazard = jax.tree.map(lambda a: jnp.tile(a[None], (500, 1)), motion((1, 2), (0.019, 0)))
        hazard = hazard if kind == "disc" else hazard.replace(velocity=0 * hazard.velocity)
        moved = jax.vmap(source.step, (0, None, 0))(hazard, motion((0, 0)), noise)
        np.testing.assert_array_equal(moved.position, hazard.position + hazard.velocity)
        change = np.asarray(moved.velocity - hazard.velocity)
        if kind == "disc":
            assert moved.velocity.max() == np.float32(0.02)
            assert 0.0018 < np.abs(change[:, 1]).max() <= 0.002
        else:
            np.testing.assert_array_equal(change, 0)


@jax.jit
def drawn(key, sub, stretch):
    ours, theirs = jax.random.split(key)
    pick = jax.vmap(sub.source.sample, (0, None))
    body, hazard = pick(jax.random.split(ours, PAIRS), sub.body)
    factor = jax.random.uniform(theirs, (PAIRS, 1), float, 1.0, stretch)
    hazard = hazard.replace(position=hazard.position * factor)
    return body, hazard, jax.vmap(sub.source.in_reach)(body, hazard)


def pairs(kind, stretch):
    """Many sampled pairs, the hazard moved away from the drone by factors up to `stretch`."""
    sub = world.sub_rmdps(params())[kind]
    return sub, *drawn(jax.random.key(0), sub, stretch)


@every_kind
def test_samples_are_in_reach_and_features_say_all(kind):
    sub, body, hazard, reach = pairs(kind, 1.0)
    assert reach.all()
    seen = jax.vmap(sub.source.features)(body, hazard)
    assert seen.shape == (PAIRS, 6)
    restored = jax.vmap(sub.source.state_of)(seen)
    again = jax.vmap(sub.source.features)(*restored)
    np.testing.assert_array_equal(again, seen)
    hits = jax.vmap(sub.source.hits)
    np.testing.assert_array_equal(hits(*restored), hits(body, hazard))
    assert 10 < hits(body, hazard).sum() < PAIRS / 2
    assert np.abs(body.velocity).max() > 0.099


@every_kind
def test_features_do_not_depend_on_where_the_drone_is(kind):
    sub, body, hazard, reach = pairs(kind, 1.0)
    shift = jnp.asarray([[3.0, -2.0]])
    moved = [m.replace(position=m.position + shift) for m in (body, hazard)]
    seen, there = (jax.vmap(sub.source.features)(*pair) for pair in ((body, hazard), moved))
    np.testing.assert_allclose(there, seen, atol=1e-6)
    assert np.mean(jax.vmap(sub.source.in_reach)(*moved) == reach) > 0.999


@jax.jit
def met(sub, keys, body, hazard, action, brakes):
    """Whether hazards (n, ...) are hit within the horizon by drones that brake, or do not.

    Every other drone that does not brake keeps its action (n,), and every other disc changes its
    velocity in the same way all along.
    """
    source, baseline, steps = sub.source, sub.body.baseline, sub.source.horizon

    def one(key, body, hazard, action):
        choice, ours, theirs, strength = jax.random.split(key, 4)
        holds, same = jax.random.bernoulli(choice, 0.5, (2,))
        actions = jax.random.randint(ours, (steps,), 0, 9).at[0].set(action)
        noise = source.draw(theirs, (steps,))
        noise = jnp.where(same, jnp.sign(noise[:1]) * source.jitter, noise)

        def advance(carry, k):
            body, hazard, hit = carry
            control = sub.body.control(jnp.where(holds, action, actions[k]))
            brake = baseline.act(body, baseline.draw(jax.random.fold_in(strength, k)))
            moved = sub.body.step(body, jnp.where(brakes & (k > 0), brake, control))
            hazard = source.step(hazard, body, noise[k])
            return (moved, hazard, hit | source.hits(moved, hazard)), None

        carry = body, hazard, source.hits(body, hazard)
        return jax.lax.scan(advance, carry, jnp.arange(steps))[0][-1]

    return jax.vmap(one)(keys, body, hazard, action)


@every_kind
@pytest.mark.parametrize("brakes", [True, False])
def test_nothing_out_of_reach_is_hit_within_the_horizon(kind, brakes):
    sub, body, hazard, reach = pairs(kind, 3.0)
    keys = jax.random.split(jax.random.key(2), PAIRS)
    action = jax.random.randint(jax.random.key(1), (PAIRS,), 0, 9)
    hit = np.asarray(met(sub, keys, body, hazard, action, brakes))
    assert not (hit & ~reach).any()
    assert (~reach).sum() > PAIRS / 4
    assert hit.sum() > 20


@pytest.mark.parametrize(
    ("kind", "speed", "farthest"),
    [
        # The 8 steps of the horizon at .1, and the radius .1.
        ("wall", 0.1, 0.9),
        # Likewise; the disc's 0 + .002 + .004 + ... + .014; the radius .12.
        ("disc", 0.1, 0.976),
    ],
)
def test_reach_is_tight_where_drone_and_hazard_make_straight_for_one_another(kind, speed, farthest):
    source, hazard = params().sources[kind], motion((0.0, 0.0))
    body, down = motion((0.0, farthest - 1e-3), (0.0, -speed)), params().body.actions[3]
    assert source.in_reach(body, hazard)
    assert not source.in_reach(motion((0.0, farthest + 1e-3), (0.0, -speed)), hazard)
    up = jnp.asarray([0.0, 1.0]) * source.jitter
    for _ in range(source.horizon):
        assert not source.hits(body, hazard)
        body, hazard = params().body.step(body, down), source.step(hazard, body, up)
    assert source.hits(body, hazard)


def test_a_number_that_is_none_is_in_reach():
    nan = motion((np.nan, 0.0))
    assert all(source.in_reach(motion((0, 0)), nan) for source in params().sources.values())


# --- the world ---


def test_a_start_is_at_rest_and_far_from_all_that_could_be_hit():
    keys = jax.random.split(jax.random.key(3), 2000)
    states = jax.jit(jax.vmap(world.reset, (0, None)))(keys, params())
    found = jax.jit(jax.vmap(functools.partial(optional.collisions, world), (0, None)))(
        states, params()
    )
    assert set(found) == set(KINDS)
    assert not any(hit.any() for hit in found.values())
    np.testing.assert_array_equal(states.body.velocity, 0)
    discs = np.asarray(states.obstacles["disc"].position)
    # Farther than a disc comes, straight on or not, while threats look ahead.
    apart = np.linalg.norm(discs - np.asarray(states.body.position)[:, None], axis=-1)
    assert apart.min() >= 0.9 > 0.12 + 8 * 0.02 * np.sqrt(2)
    assert (discs >= 0).all()
    assert (discs <= np.asarray(world.FIELD)).all()
    assert np.abs(states.obstacles["disc"].velocity).max() <= 0.02


def test_a_step_earns_the_way_to_the_goal():
    # Straight at the goal (3.7, .7): from 1.0 to .9 away, at the top speed.
    reached, outcome = step(start((2.7, 0.7), (0.1, 0.0), disc=far_discs()), 4)
    np.testing.assert_allclose(reached.body.position, [2.8, 0.7], rtol=1e-6)
    np.testing.assert_allclose(outcome.reward, 10 * 0.1 - 0.05, rtol=1e-4)
    assert reached.time == 1
    assert not outcome.done
    assert outcome.danger == 0
    # Aside, from (3.0, 1.0): its distance grows from sqrt(.49 + .09) to sqrt(.49 + .16).
    _, outcome = step(start((3.0, 1.0), (0.0, 0.1), disc=far_discs()), 4)
    np.testing.assert_allclose(outcome.reward, 10 * (0.58**0.5 - 0.65**0.5) - 0.05, rtol=1e-4)


def test_the_goal_ends_an_episode_with_a_bonus():
    _, outcome = step(start((3.35, 0.7), (0.1, 0.0), disc=far_discs()), 4)  # .35 to .25
    assert outcome.goal
    assert outcome.terminated
    assert not outcome.truncated
    np.testing.assert_allclose(outcome.reward, 1.0 - 0.05 + 5.0, rtol=1e-4)


@pytest.mark.parametrize(
    ("kind", "position", "velocity"),
    [
        ("disc", (3.5, 1.9), (0.1, 0.0)),
        ("pylon", (2.0, 1.15), (0.0, -0.1)),
        ("wall", (0.5, 0.15), (0, -0.1)),
    ],
)
def test_a_hit_ends_an_episode_with_danger(kind, position, velocity):
    discs = far_discs(d3=((3.7, 1.9), (0.0, 0.0)))
    reached, outcome = step(start(position, velocity, disc=discs), 4)
    assert outcome.danger == 1
    assert outcome.terminated
    assert not outcome.goal
    found = optional.collisions(world, reached, params())
    assert {name for name, hit in found.items() if hit} == {kind}


def test_a_hit_at_the_goal_is_no_goal():
    discs = far_discs(d3=((3.55, 0.7), (0.0, 0.0)))
    _, outcome = step(start((3.35, 0.7), (0.1, 0.0), disc=discs), 4)
    assert outcome.danger == 1
    assert not outcome.goal
    np.testing.assert_allclose(outcome.reward, 1.0 - 0.05, rtol=1e-4)


def test_discs_turn_back_at_the_sides_of_the_field():
    moved = {
        "d0": ((0.01, 1.0), (-0.02, 0.01)),  # leaves on the left
        "d1": ((3.99, 1.99), (0.02, 0.02)),  # leaves in the corner
        "d2": ((-0.05, 1.0), (0.02, 0.01)),  # comes back already
        "d3": ((1.0, 1.0), (-0.02, 0.01)),
    }
    reached, _ = step(start((0.5, 0.5), disc=far_discs(**moved)), 4)
    discs = reached.obstacles["disc"]
    np.testing.assert_allclose(discs.position[:2], [[-0.01, 1.01], [4.01, 2.01]], atol=1e-6)
    signs = np.sign(discs.velocity[:4])
    np.testing.assert_array_equal(signs, [[1, 1], [-1, -1], [1, 1], [-1, 1]])
    jitter = np.abs(discs.velocity[:4]) - np.abs([way for _, way in moved.values()])
    assert np.abs(jitter).max() <= 0.0021
    fixed = [reached.obstacles[kind].position for kind in ("pylon", "wall")]
    np.testing.assert_array_equal(fixed[0], np.float32(world.PYLONS))
    np.testing.assert_array_equal(fixed[1], [[0, 0]])


def test_the_nearest_discs_are_observed():
    near = {"d7": ((1.5, 1.0), (0.01, 0.0)), "d2": ((1.0, 1.2), (0.0, -0.02))}
    state = start((1.0, 1.0), (0.1, 0.05), disc=far_discs(**near))
    seen = np.asarray(world.observe(state, params()))
    assert seen.shape == (26,)
    np.testing.assert_allclose(seen[:2], [2.7, -0.3], rtol=1e-5)
    np.testing.assert_allclose(seen[2:8], [0, 0.2, 0.1, 0.05, 0, -0.02], atol=1e-6)
    np.testing.assert_allclose(seen[8:14], [0.5, 0, 0.1, 0.05, 0.01, 0], atol=1e-6)
    np.testing.assert_allclose(seen[14:20], [2.9, 0.9, 0.1, 0.05, 0, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"discs": 3}, "discs is 3; it must be"),
        ({"discs": 4.5}, "discs is 4.5; it must be"),
        ({"time_limit": 0}, "time_limit is 0; it must be"),
    ],
)
def test_numbers_out_of_range_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        world.make_params(**settings)


def test_the_world_keeps_the_contract():
    check.check_env(world, world.make_params(4))


def test_threats_of_a_world_with_plain_numbers_are_saved_and_found_again(tmp_path):
    """The radius of an obstacle is a Python float; models that went through jit hold arrays."""
    subs, models = world.sub_rmdps(params()), {}
    network = ThreatNetwork((8,), 9)
    weights = network.init(jax.random.key(0), jnp.zeros(6))
    for kind, sub in subs.items():
        source = jax.tree.map(jnp.asarray, sub.source)
        models[kind] = ThreatModel(source, weights, jnp.ones(6), jnp.asarray(0.0), network)
    ThreatFunction(models, dict(subs)).save(tmp_path, "examples.drone.world")
    found = load_threat(tmp_path, world.sub_rmdps(world.make_params(discs=20)))
    assert list(found.models) == KINDS
    found.check_fits(subs)
