import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax.envs import circuit, jam
from rp_jax.hazards import MovingObstacle, WallPoint, Window, reach
from rp_jax.kinematics import Vehicle, make_vehicle, mirrored_actions, rotate

KINDS = [(circuit, "wall"), (jam, "wall"), (jam, "obstacle")]
NAMES = ["circuit-wall", "jam-wall", "jam-obstacle"]
SPEEDS = [-0.04, 0.0, 0.02, 0.05, 0.1]
each_kind = pytest.mark.parametrize(("env", "kind"), KINDS, ids=NAMES)


@functools.lru_cache
def params_of(env, double):
    assert double == jax.config.jax_enable_x64
    return env.make_params()


def sub_of(env, kind):
    return env.sub_rmdps(params_of(env, jax.config.jax_enable_x64))[kind]


def pick(tree, index):
    return jax.tree.map(lambda table: table[index], tree)


def sequences(rng, rows, steps, choices):
    """Indices (rows, steps) into a table: half the rows repeat one, which leads farthest."""
    free, same = rng.integers(choices, size=(rows, steps)), rng.integers(choices, size=(rows, 1))
    return jnp.asarray(np.where(rng.random((rows, 1)) < 0.5, same, free))


def directions(rng, rows):
    angle = rng.uniform(-np.pi, np.pi, rows)
    return jnp.asarray(np.stack([np.cos(angle), np.sin(angle)], axis=-1))


def path(start, controls, step):
    """Positions (steps + 1, 2) from `start` under `controls`."""
    end, visited = jax.lax.scan(lambda v, c: (step(v, c), v), start, controls)
    return jnp.concatenate([visited.position, end.position[None]])


@functools.lru_cache
def encounters(env, kind):
    """Agents anywhere, each with a hazard whose rim it comes to within the horizon.

    Returns their features (20,000, F), the features of the states that have these features, and
    whether the hazard was hit.
    """
    sub, rows, rng = sub_of(env, kind), 20_000, np.random.default_rng(0)
    source, model, steps = sub.source, sub.agent, sub.source.horizon
    table = jax.tree.map(lambda *a: jnp.concatenate(a), model.actions, model.baseline.controls)
    controls = pick(table, sequences(rng, rows, steps, len(table.acceleration)))
    place = jnp.asarray(rng.uniform(-3, 3, (rows, 2)))
    speed = jnp.asarray(rng.choice(np.asarray(model.speeds), rows))
    agents = Vehicle(position=place, heading=directions(rng, rows), speed=speed)
    when, rim = jnp.asarray(rng.integers(steps + 1, size=rows)), directions(rng, rows) * (1 - 1e-9)
    if kind == "wall":
        noise, others = jnp.zeros((rows, steps)), jnp.zeros((rows, 2))
    else:
        drives = source.behaviour.controls
        noise = pick(drives, sequences(rng, rows, steps, len(drives.acceleration)))
        fast = jnp.asarray(rng.choice(np.asarray(source.speeds), rows))
        start = jnp.zeros((rows, 2))
        others = Vehicle(position=start, heading=directions(rng, rows), speed=fast)

    def meet(agent, controls, when, rim, hazard, noise):
        there = path(agent, controls, model.step)[when]
        if kind == "wall":
            hazard = there + source.radius * rim
        else:
            moved = path(hazard, noise, lambda other, c: source.step(other, agent, c))[when]
            hazard = hazard.replace(position=there + source.distance * rim - moved)

        def move(carry, now):
            us, other = carry
            after = model.step(us, now[0]), source.step(other, us, now[1])
            return after, source.hits(us, other)

        end, hits = jax.lax.scan(move, (agent, hazard), (controls, noise))
        features = source.features(agent, hazard)
        again = source.features(*source.state_of(features))
        return features, again, hits.any() | source.hits(*end)

    return jax.jit(jax.vmap(meet))(agents, controls, when, rim, others, noise)


@each_kind
def test_whatever_can_be_hit_within_the_horizon_lies_in_the_window(env, kind, x64):
    features, _, hit = encounters(env, kind)
    assert hit.all()  # they do meet
    window = sub_of(env, kind).source.window
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
    for small, large in itertools.pairwise(windows):
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


def test_what_is_nowhere_counts_as_inside_a_window_so_that_it_is_noticed():
    window = Window(lower=jnp.asarray([-1.0, -2.0]), upper=jnp.asarray([3.0, 4.0]))
    assert window.contains(jnp.asarray([[jnp.nan, 0.0], [0.0, jnp.nan]])).all()


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
    features = np.asarray(jax.jit(jax.vmap(sub.source.features))(agents, hazards))
    lower, upper = np.asarray(sub.source.window.lower), np.asarray(sub.source.window.upper)
    assert (features[:, :2] >= lower).all()
    assert (features[:, :2] <= upper).all()
    share = (features[:, :2] - lower) / (upper - lower)
    assert (
        np.abs(np.quantile(share, [0.25, 0.5, 0.75], axis=0).T - [0.25, 0.5, 0.75]) < 0.03
    ).all()
    columns = (
        {2: sub.agent.speeds} if kind == "wall" else {5: sub.agent.speeds, 4: sub.source.speeds}
    )
    for column, speeds in columns.items():
        drawn, speeds = features[:, column], np.asarray(speeds)
        assert (drawn >= speeds[0]).all()
        assert (drawn <= speeds[-1]).all()
        on_grid = np.isin(drawn, speeds)
        assert abs(on_grid.mean() - 0.5) < 0.05
        assert np.unique(drawn[on_grid]).size == speeds.size


@each_kind
def test_state_of_inverts_features_of_any_pose(env, kind, x64):
    features, again, _ = encounters(env, kind)
    np.testing.assert_allclose(again, features, atol=1e-12)


def test_features_are_what_the_agent_sees_in_its_own_frame():
    agent = make_vehicle((1.0, 1.0), np.pi / 2, 0.04)
    wall, obstacle = (
        jam.sub_rmdps(jam.make_params())[kind].source for kind in ("wall", "obstacle")
    )
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
def test_mirrored_walls_threaten_the_mirrored_actions_alike(env, exact, x64):
    sub = sub_of(env, "wall")
    rng = np.random.default_rng(3)
    columns = [rng.uniform(-0.2, 0.5, 250), rng.uniform(-0.3, 0.3, 250), rng.choice(SPEEDS, 250)]
    features = jnp.asarray(np.stack(columns, axis=-1))
    here = exact(features, sub).threat
    there = exact(jax.vmap(sub.source.mirrored)(features), sub).threat
    assert (here > 0.01).any(axis=1).mean() > 0.2
    assert not np.allclose(here, there, atol=1e-3)
    np.testing.assert_allclose(there[:, mirrored_actions(sub.agent.actions)], here, atol=1e-9)


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
    mirror = mirrored_actions(sub.agent.actions)
    error = np.sqrt(np.square(here.stderr) + np.square(there.stderr[:, mirror]) + 1e-6)
    assert np.abs(there.threat[:, mirror] - here.threat).max() > 0  # other draws
    assert (np.abs(there.threat[:, mirror] - here.threat) < 5 * error).all()
    assert (np.abs(there.threat - here.threat) > 20 * error).any()


@functools.partial(jax.jit, static_argnums=(0, 2))
def states_of(env, params, count):
    """Keys and states with the agent turned anywhere and at any speed."""
    keys = jax.random.split(jax.random.key(7), count)
    states = jax.vmap(env.reset, (0, None))(keys, params)
    angle = jax.random.uniform(jax.random.key(8), (count,), float, -jnp.pi, jnp.pi)
    heading = rotate(states.agent.heading, jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1))
    low, high = params.agent.speeds[0], params.agent.speeds[-1]
    speed = jax.random.uniform(jax.random.key(9), (count,), float, low, high)
    agent = Vehicle(position=states.agent.position, heading=heading, speed=speed)
    return keys, states.replace(agent=agent)


def same_bits(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_the_agent_of_the_circuit_and_of_its_sub_rmdp_move_alike_to_the_bit():
    params = params_of(circuit, False)
    keys, states = states_of(circuit, params, 90)
    actions = jnp.arange(90) % 15
    reached, _ = jax.jit(jax.vmap(circuit.step, (0, 0, 0, None)))(keys, states, actions, params)
    model = circuit.sub_rmdps(params)["wall"].agent
    alone = jax.jit(jax.vmap(model.step))(states.agent, pick(model.actions, actions))
    same_bits(alone, reached.agent)


def test_the_vehicles_of_the_jam_and_of_its_sub_rmdps_move_alike_to_the_bit():
    params = params_of(jam, False)
    keys, states = states_of(jam, params, 90)
    actions = jnp.arange(90) % 15
    draws = jax.jit(jax.vmap(jam.draw, (0, 0, 0, None)))(keys, states, actions, params)
    nowhere = jax.tree.map(lambda a: jnp.full_like(a, jnp.nan), draws.relocated)
    transition = jax.jit(jax.vmap(jam.transition, (0, 0, 0, None)))
    reached, _ = transition(states, actions, draws.replace(relocated=nowhere), params)

    subs = jam.sub_rmdps(params)
    model, source = subs["obstacle"].agent, subs["obstacle"].source
    alone = jax.jit(jax.vmap(model.step))(states.agent, pick(model.actions, actions))
    same_bits(alone, reached.agent)
    same_bits(subs["wall"].agent, model)
    move = jax.jit(jax.vmap(jax.vmap(source.step, (0, None, 0))))
    alone = move(states.obstacles, states.agent, draws.controls)
    stayed = ~np.isnan(np.asarray(reached.obstacles.speed))
    assert 0.5 < stayed.mean() < 1
    same_bits(pick(alone, stayed), pick(reached.obstacles, stayed))
