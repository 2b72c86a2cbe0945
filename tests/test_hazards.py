import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax.envs import circuit, jam
from rp_jax.hazards import MovingObstacle, WallPoint, Window, reach
from rp_jax.kinematics import Vehicle, make_vehicle, mirrored_actions, rotate
from rp_jax.recon.labels import exact_threat, monte_carlo_threat

KINDS = [(circuit, "wall"), (jam, "wall"), (jam, "obstacle")]
NAMES = ["circuit-wall", "jam-wall", "jam-obstacle"]
each_kind = pytest.mark.parametrize(("env", "kind"), KINDS, ids=NAMES)


def sub_of(env, kind):
    return env.sub_rmdps(env.make_params())[kind]


def pick(tree, index):
    return jax.tree.map(lambda table: table[index], tree)


def sequence(key, table, steps):
    """Controls (steps,) from a table: half the time one alone, which leads farthest."""
    often, one, many = jax.random.split(key, 3)
    count = len(table.acceleration)
    same = jnp.full(steps, jax.random.randint(one, (), 0, count))
    free = jax.random.randint(many, (steps,), 0, count)
    return pick(table, jnp.where(jax.random.bernoulli(often), same, free))


def path(start, controls, step):
    """Positions (steps + 1, 2) from `start` under `controls`."""
    end, visited = jax.lax.scan(lambda v, c: (step(v, c), v), start, controls)
    return jnp.concatenate([visited.position, end.position[None]])


def encounter(key, sub):
    """An agent anywhere and a hazard that it hits within the horizon, at the hazard's rim."""
    source, model, steps = sub.source, sub.agent, sub.source.horizon
    keys = jax.random.split(key, 9)
    union = jax.tree.map(
        lambda *a: jnp.concatenate(a), model.actions, model.baseline.controls
    )
    controls = sequence(keys[0], union, steps)
    speeds = jnp.concatenate([model.speeds, model.speeds[:1], model.speeds[-1:]])
    angle = jax.random.uniform(keys[1], (), float, -jnp.pi, jnp.pi)
    place = jax.random.uniform(keys[2], (2,), float, -3.0, 3.0)
    agent = make_vehicle(place, angle, jax.random.choice(keys[3], speeds))
    ours = path(agent, controls, model.step)
    when = jax.random.randint(keys[4], (), 0, steps + 1)
    side = jax.random.uniform(keys[5], (), float, -jnp.pi, jnp.pi)
    rim = (1 - 1e-9) * jnp.stack([jnp.cos(side), jnp.sin(side)])
    if isinstance(source, WallPoint):
        hazard, noise = ours[when] + source.radius * rim, jnp.zeros(steps)
    else:
        noise = sequence(keys[6], source.behaviour.controls, steps)
        turn = jax.random.uniform(keys[7], (), float, -jnp.pi, jnp.pi)
        fast = jax.random.choice(keys[8], source.speeds)
        hazard = make_vehicle(jnp.zeros(2), turn, fast)
        theirs = path(hazard, noise, lambda v, c: source.step(v, agent, c))
        where = ours[when] + source.distance * rim - theirs[when]
        hazard = hazard.replace(position=where)

    def meets(carry, move):
        us, other = carry
        hit = source.hits(us, other)
        return (model.step(us, move[0]), source.step(other, us, move[1])), hit

    end, hits = jax.lax.scan(meets, (agent, hazard), (controls, noise))
    return agent, hazard, hits.any() | source.hits(*end)


@each_kind
def test_whatever_can_be_hit_within_the_horizon_lies_in_the_window(env, kind, x64):
    sub = sub_of(env, kind)
    keys = jax.random.split(jax.random.key(0), 20_000)
    agents, hazards, hit = jax.jit(jax.vmap(encounter, (0, None)))(keys, sub)
    assert hit.all()  # they do meet
    features = jax.vmap(sub.source.features)(agents, hazards)
    window = sub.source.window
    assert window.contains(features[:, :2]).all()
    # The window is not so wide that anything would pass: ahead it is nearly reached.
    assert features[:, 0].max() > 0.95 * window.upper[0]
    assert features[:, 1].max() > 0.8 * window.upper[1]
    assert features[:, 1].min() < 0.8 * window.lower[1]


@each_kind
def test_the_window_grows_with_the_horizon(env, kind):
    sub = sub_of(env, kind)
    args = () if kind == "wall" else (sub.source.speeds, sub.source.behaviour)
    windows = [type(sub.source).create(sub.agent, *args, horizon=h).window for h in (1, 3, 5, 8)]
    for small, large in zip(windows, windows[1:], strict=False):
        assert (large.upper > small.upper).all()
        assert (large.lower < small.lower).all()


def test_the_reach_of_the_circuits_vehicle_is_that_worked_out_by_hand():
    lower, upper = reach(circuit.make_params().agent, 2)
    # Full speed ahead, or reversing, for two steps; the second up to .15 rad to the side.
    np.testing.assert_allclose(upper, [0.2, 0.1 * np.sin(0.15)], atol=1e-6)
    np.testing.assert_allclose(lower, [-0.08, -0.1 * np.sin(0.15)], atol=1e-6)


def test_a_window_contains_its_corners_and_nothing_outside():
    window = Window(lower=jnp.asarray([-1.0, -2.0]), upper=jnp.asarray([3.0, 4.0]))
    inside = jnp.asarray([[-1.0, -2.0], [3.0, 4.0], [0.0, 0.0]])
    outside = jnp.asarray([[-1.1, 0.0], [3.1, 0.0], [0.0, -2.1], [0.0, 4.1]])
    assert window.contains(inside).all()
    assert not window.contains(outside).any()


def test_a_hazard_at_exactly_its_distance_is_not_hit():
    agent = make_vehicle((0.0, 0.0), 0.0, 0.0)
    model = jam.make_params().agent
    nearer = jnp.nextafter(jnp.float32(0.25), jnp.float32(0))
    wall = WallPoint.create(model, radius=0.25)
    assert not wall.hits(agent, jnp.asarray([0.25, 0.0]))
    assert wall.hits(agent, jnp.stack([nearer, jnp.float32(0)]))
    known = jam.make_params().obstacle
    other = MovingObstacle.create(model, known.speeds, known.behaviour, distance=0.25)
    assert not other.hits(agent, make_vehicle((0.0, 0.25), 1.0, 0.0))
    assert other.hits(agent, make_vehicle((0.0, float(nearer)), 1.0, 0.0))


@each_kind
def test_samples_fill_the_window_and_hold_the_reachable_speeds(env, kind):
    sub = sub_of(env, kind)
    keys = jax.random.split(jax.random.key(1), 8000)
    agents, hazards = jax.jit(jax.vmap(sub.source.sample, (0, None)))(keys, sub.agent)
    features = np.asarray(jax.vmap(sub.source.features)(agents, hazards))
    window = sub.source.window
    assert window.contains(jnp.asarray(features[:, :2])).all()
    share = (features[:, :2] - window.lower) / (window.upper - window.lower)
    assert (np.abs(np.quantile(share, [0.25, 0.5, 0.75], axis=0).T - [0.25, 0.5, 0.75]) < 0.03).all()
    columns = {2: sub.agent.speeds} if kind == "wall" else {5: sub.agent.speeds, 4: sub.source.speeds}
    for column, speeds in columns.items():
        drawn, speeds = features[:, column], np.asarray(speeds)
        assert (drawn >= speeds[0]).all()
        assert (drawn <= speeds[-1]).all()
        on_grid = np.isin(drawn, speeds)
        assert abs(on_grid.mean() - 0.5) < 0.05
        assert np.unique(drawn[on_grid]).size == speeds.size


@each_kind
def test_state_of_inverts_features_of_any_pose(env, kind):
    sub = sub_of(env, kind)
    keys = jax.random.split(jax.random.key(2), 500)
    agents, hazards, _ = jax.jit(jax.vmap(encounter, (0, None)))(keys, sub)
    features = jax.vmap(sub.source.features)(agents, hazards)
    ours, others = jax.vmap(sub.source.state_of)(features)
    again = jax.vmap(sub.source.features)(ours, others)
    np.testing.assert_allclose(again, features, atol=1e-6)


def test_features_are_what_the_agent_sees_in_its_own_frame():
    agent = make_vehicle((1.0, 1.0), np.pi / 2, 0.04)
    wall, obstacle = (jam.sub_rmdps(jam.make_params())[kind].source for kind in ("wall", "obstacle"))
    np.testing.assert_allclose(
        wall.features(agent, jnp.asarray([0.9, 1.3])), [0.3, 0.1, 0.04], atol=1e-6
    )
    other = make_vehicle((1.2, 1.0), 0.0, 0.06)  # to the right, and driving to the right
    np.testing.assert_allclose(
        obstacle.features(agent, other), [0.0, -0.2, 0.0, -1.0, 0.06, 0.04], atol=1e-6
    )


def mirrored_by_hand(vehicle):
    flip = jnp.asarray([1.0, -1.0])
    return vehicle.replace(position=vehicle.position * flip, heading=vehicle.heading * flip)


@each_kind
def test_mirrored_features_are_those_of_the_mirrored_situation(env, kind):
    source = sub_of(env, kind).source
    agent = make_vehicle((0.3, 0.2), 0.7, -0.02)
    hazard = jnp.asarray([0.5, 0.9]) if kind == "wall" else make_vehicle((0.5, 0.9), 2.0, 0.04)
    other = hazard * jnp.asarray([1.0, -1.0]) if kind == "wall" else mirrored_by_hand(hazard)
    expected = source.features(mirrored_by_hand(agent), other)
    np.testing.assert_allclose(source.mirrored(source.features(agent, hazard)), expected, atol=1e-6)


@pytest.mark.parametrize("env", [circuit, jam])
def test_mirrored_walls_threaten_the_mirrored_actions_alike(env, x64):
    sub = sub_of(env, "wall")
    keys = jax.random.split(jax.random.key(3), 64)
    agents, hazards = jax.vmap(sub.source.sample, (0, None))(keys, sub.agent)
    features = jax.vmap(sub.source.features)(agents, hazards)

    def threats(features):
        one = lambda f: exact_threat(None, *sub.source.state_of(f), sub).threat  # noqa: E731
        return jax.lax.map(one, features, batch_size=32)

    label = jax.jit(threats)
    here, there = label(features), label(sub.source.mirrored(features))
    assert (here > 0.01).any(axis=1).mean() > 0.2
    assert not np.allclose(here, there, atol=1e-3)
    np.testing.assert_allclose(there[:, mirrored_actions(sub.agent.actions)], here, atol=1e-9)


def test_mirrored_obstacles_threaten_the_mirrored_actions_alike():
    sub = sub_of(jam, "obstacle")
    rng = np.random.default_rng(4)
    side, turn = rng.uniform(-np.pi, np.pi, (2, 24))
    away = rng.uniform(0.22, 0.6, 24)
    speeds = rng.choice([0.02, 0.04, 0.06], 24), rng.uniform(-0.1, 0.1, 24)
    columns = [away * np.cos(side), away * np.sin(side), np.cos(turn), np.sin(turn), *speeds]
    features = jnp.asarray(np.stack(columns, axis=-1), float)

    def threats(key, features):
        agents, others = jax.vmap(sub.source.state_of)(features)
        one = lambda row: monte_carlo_threat(*row, sub, 4000)  # noqa: E731
        return jax.lax.map(one, (jax.random.split(key, len(features)), agents, others))

    label = jax.jit(threats)
    here = label(jax.random.key(5), features)
    there = label(jax.random.key(6), sub.source.mirrored(features))
    mirror = mirrored_actions(sub.agent.actions)
    error = np.sqrt(np.square(here.stderr) + np.square(there.stderr[:, mirror]) + 1e-6)
    assert np.abs(there.threat[:, mirror] - here.threat).max() > 0  # other draws
    assert (np.abs(there.threat[:, mirror] - here.threat) < 5 * error).all()
    assert (np.abs(there.threat - here.threat) > 20 * error).any()


def states_of(env, params, count):
    keys = jax.random.split(jax.random.key(7), count)
    states = jax.vmap(env.reset, (0, None))(keys, params)
    model = params.agent
    angle = jax.random.uniform(jax.random.key(8), (count,), float, -jnp.pi, jnp.pi)
    heading = rotate(states.agent.heading, jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1))
    low, high = model.speeds[0], model.speeds[-1]
    speed = jax.random.uniform(jax.random.key(9), (count,), float, low, high)
    agent = Vehicle(position=states.agent.position, heading=heading, speed=speed)
    return keys, states.replace(agent=agent)


def same_bits(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.mark.parametrize("env", [circuit, jam])
def test_the_agent_of_an_environment_and_of_a_sub_rmdp_move_alike_to_the_bit(env):
    params = env.make_params()
    keys, states = states_of(env, params, 90)
    actions = jnp.arange(90) % 15
    reached, _ = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))(keys, states, actions, params)
    for sub in env.sub_rmdps(params).values():
        alone = jax.jit(jax.vmap(sub.agent.step))(states.agent, pick(sub.agent.actions, actions))
        same_bits(alone, reached.agent)


def test_the_obstacles_of_an_environment_and_of_a_sub_rmdp_move_alike_to_the_bit():
    params = jam.make_params(8)
    keys, states = states_of(jam, params, 90)
    actions = jnp.arange(90) % 15
    draws = jax.vmap(jam.draw, (0, 0, 0, None))(keys, states, actions, params)
    nowhere = jax.tree.map(lambda a: jnp.full_like(a, jnp.nan), draws.relocated)
    transition = jax.jit(jax.vmap(jam.transition, (0, 0, 0, None)))
    reached, _ = transition(states, actions, draws.replace(relocated=nowhere), params)
    source = jam.sub_rmdps(params)["obstacle"].source
    move = jax.jit(jax.vmap(jax.vmap(source.step, (0, None, 0))))
    alone = move(states.obstacles, states.agent, draws.controls)
    stayed = ~np.isnan(np.asarray(reached.obstacles.speed))
    assert 0.5 < stayed.mean() < 1
    same_bits(jax.tree.map(lambda a: a[stayed], alone), pick(reached.obstacles, stayed))
