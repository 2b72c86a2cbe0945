import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax.envs import circuit, jam, point_gather
from rp_jax.hazards import MovingObstacle, Reach, WallPoint, Window
from rp_jax.kinematics import (
    Control,
    Vehicle,
    angle_of,
    make_vehicle,
    mirrored_actions,
)
from rp_jax.recon.labels import exact_threat, label, monte_carlo_threat

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
    return np.where(rng.random((rows, 1)) < 0.5, same, free)


def directions(rng, rows):
    angle = rng.uniform(-np.pi, np.pi, rows)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


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
    sub, rows, rng = jax.device_get(sub_of(env, kind)), 20_000, np.random.default_rng(0)
    source, model, steps = sub.source, sub.agent, sub.source.horizon
    table = jax.tree.map(lambda *a: np.concatenate(a), model.actions, model.baseline.controls)
    controls = pick(table, sequences(rng, rows, steps, len(table.acceleration)))
    place, speed = rng.uniform(-3, 3, (rows, 2)), rng.choice(model.speeds, rows)
    agents = Vehicle(position=place, heading=directions(rng, rows), speed=speed)
    when, rim = rng.integers(steps + 1, size=rows), directions(rng, rows) * (1 - 1e-9)
    if kind == "wall":
        noise, others = np.zeros((rows, steps)), np.zeros((rows, 2))
    else:
        drives = source.behaviour.controls
        noise = pick(drives, sequences(rng, rows, steps, len(drives.acceleration)))
        fast, start = rng.choice(source.speeds, rows), np.zeros((rows, 2))
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

    met = jax.jit(jax.vmap(meet))(agents, controls, when, rim, others, noise)
    return jax.device_get(met)


@each_kind
def test_whatever_can_be_hit_within_the_horizon_lies_in_the_window(env, kind, x64):
    features, _, hit = encounters(env, kind)
    assert hit.all()  # they do meet
    source = sub_of(env, kind).source
    window = jax.device_get(source.window)
    assert window.contains(features[:, :2]).all()
    reached = jax.jit(jax.vmap(lambda f: source.in_reach(*source.state_of(f))))(features)
    assert reached.all()
    # The window is not so wide that anything would pass: ahead it is nearly reached.
    assert features[:, 0].max() > 0.95 * window.upper[0]
    assert features[:, 1].max() > 0.8 * window.upper[1]
    assert features[:, 1].min() < 0.8 * window.lower[1]


def steepest(turn, steps):
    """Turns that bring a vehicle to a right angle as fast as it can, and no farther."""
    swing = np.minimum(turn * np.arange(1, steps + 1), np.pi / 2)
    return np.diff(swing, prepend=0.0)


@each_kind
@pytest.mark.parametrize("side", ["ahead", "behind", "left", "right"])
def test_the_farthest_meeting_lies_just_inside_the_window(env, kind, side, x64):
    sub = sub_of(env, kind)
    model, source, steps = sub.agent, sub.source, sub.source.horizon
    fast, slow = float(model.speeds[-1]), float(model.speeds[0])
    most = float(np.abs(angle_of(model.actions.rotation)).max())
    towards = {"ahead": (1, 0), "behind": (-1, 0), "left": (0, 1), "right": (0, -1)}[side]
    towards = np.asarray(towards, float)
    turns = np.zeros(steps) if towards[0] else towards[1] * steepest(most, steps)
    rotation = jnp.asarray(np.stack([np.cos(turns), np.sin(turns)], axis=-1))
    controls = Control(acceleration=jnp.zeros(steps), rotation=rotation)
    agent = make_vehicle((0.0, 0.0), 0.0, slow if side == "behind" else fast)
    last = path(agent, controls, model.step)[-1]
    rim = source.radius if kind == "wall" else source.distance
    place = last + (rim - 1e-9) * towards
    if kind == "wall":
        hazard = other = place
    else:  # it comes straight at the agent
        far = place + steps * source.speeds[-1] * towards
        heading = np.arctan2(-towards[1], -towards[0])
        hazard = make_vehicle(far, heading, source.speeds[-1])
        other = hazard.replace(position=place)
    assert source.hits(agent.replace(position=last), other)
    relative = source.features(agent, hazard)[:2]
    window = source.window
    assert window.contains(relative)
    assert source.in_reach(agent, hazard)
    limit = towards @ np.where(towards > 0, window.upper, window.lower)
    np.testing.assert_allclose(towards @ relative, limit, atol=2e-5)


@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("direction", [1, -1])
def test_what_is_in_reach_ahead_depends_on_the_speed_as_worked_out(speed, direction, x64):
    sub = sub_of(circuit, "wall")
    speeds = [speed]
    for _ in range(sub.source.horizon - 1):
        speeds.append(np.clip(speeds[-1] + direction * 0.02, -0.04, 0.1))
    # Where it stands now is a place it comes by; on a straight way those are all between.
    farthest = max(0, *(direction * np.cumsum(speeds))) + 0.1
    agent = make_vehicle((0.0, 0.0), 0.0, speed)
    inside, outside = [jnp.asarray([direction * (farthest + d), 0.0]) for d in (-1e-9, 2e-2)]
    assert sub.source.in_reach(agent, inside)
    # Turning round costs more than a step's reach here, so nothing else leads there.
    beyond = sub.source.in_reach(agent, outside)
    assert not beyond or direction * speed < 0


def test_a_speed_beyond_the_limits_is_believed(x64):
    sub = sub_of(circuit, "wall")
    agent = make_vehicle((0.0, 0.0), 0.0, 0.5)  # moves .5, then at most .48, ...
    assert sub.source.in_reach(agent, jnp.asarray([2.0, 0.0]))


@each_kind
def test_what_is_out_of_reach_has_no_threat(env, kind):
    sub = sub_of(env, kind)
    key, spread = jax.random.key(3), sub.source.window
    agents, hazards = jax.vmap(sub.source.sample, (0, None))(jax.random.split(key, 4000), sub.agent)
    anywhere = jax.random.uniform(key, (4000, 2), float, spread.lower, spread.upper)
    hazards = anywhere if kind == "wall" else hazards.replace(position=anywhere)
    out = ~jax.jit(jax.vmap(sub.source.in_reach))(agents, hazards)
    assert 0.1 < out.mean() < 0.95
    estimator = exact_threat if kind == "wall" else functools.partial(monte_carlo_threat, paths=16)
    found = label(key, pick(agents, out), pick(hazards, out), sub, estimator)
    assert (found.threat == 0).all()


@each_kind
def test_the_window_grows_with_the_horizon(env, kind):
    sub = sub_of(env, kind)
    args = () if kind == "wall" else (sub.source.speeds, sub.source.behaviour)
    windows = [type(sub.source).create(sub.agent, *args, horizon=h).window for h in (1, 3, 5, 8)]
    for small, large in itertools.pairwise(windows):
        assert (large.upper > small.upper).all()
        assert (large.lower < small.lower).all()


def test_the_reach_of_the_circuits_vehicle_is_that_worked_out_by_hand():
    reach = Reach.create(circuit.make_params().agent, 2)
    lower, upper = reach.box(jnp.asarray(-0.04)).lower, reach.box(jnp.asarray(0.1)).upper
    # Full speed ahead, or reversing, for two steps; the second up to .15 rad to the side.
    np.testing.assert_allclose(upper, [0.2, 0.1 * np.sin(0.15)], atol=1e-6)
    np.testing.assert_allclose(lower, [-0.08, -0.04 * np.sin(0.15)], atol=1e-6)


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


@pytest.mark.parametrize(("env", "kind"), [(circuit, "wall"), (jam, "obstacle")])
def test_samples_fill_the_window_and_hold_the_reachable_speeds(env, kind):
    sub = sub_of(env, kind)
    keys = jax.random.split(jax.random.key(1), 8000)
    agents, hazards = jax.jit(jax.vmap(sub.source.sample, (0, None)))(keys, sub.agent)
    features = np.asarray(jax.jit(jax.vmap(sub.source.features))(agents, hazards))
    lower, upper = np.asarray(sub.source.window.lower), np.asarray(sub.source.window.upper)
    assert (features[:, :2] >= lower).all()
    assert (features[:, :2] <= upper).all()
    assert jax.vmap(sub.source.in_reach)(agents, hazards).all()
    at = sub.source.window_at
    speeds = [agents.speed] if kind == "wall" else [agents.speed, hazards.speed]
    lower, upper = (np.asarray(a) for a in jax.tree.leaves(jax.vmap(at)(*speeds)))
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


def test_state_of_makes_headings_of_any_length_unit_vectors():
    source = sub_of(jam, "obstacle").source
    _, other = source.state_of(jnp.asarray([0.1, 0.2, 1.5, -2.0, 0.02, 0.04]))
    np.testing.assert_allclose(other.heading, [0.6, -0.8], atol=1e-6)


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


def agents_of(model, places):
    """Agents (90,) at random poses and speeds about the given places, and an action of each."""
    rng = np.random.default_rng(7)
    where = rng.choice(np.asarray(places), 90)
    speed = rng.uniform(float(model.speeds[0]), float(model.speeds[-1]), 90)
    agents = make_vehicle(where + rng.uniform(-0.05, 0.05, (90, 2)), rng.uniform(-3, 3, 90), speed)
    return agents, jnp.arange(90) % 15


def same_bits(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_the_agent_of_the_circuit_and_of_its_sub_rmdp_move_alike_to_the_bit():
    params = params_of(circuit, False)
    model = circuit.sub_rmdps(params)["wall"].agent
    agents, actions = agents_of(model, params.track.centre)
    zero = jnp.zeros(90, jnp.int32)
    states = circuit.State(agent=agents, index=zero, time=zero, lost=zero > 0)
    step = jax.jit(jax.vmap(circuit.step, (None, 0, 0, None)))
    reached, _ = step(jax.random.key(0), states, actions, params)
    alone = jax.jit(jax.vmap(model.step))(agents, pick(model.actions, actions))
    same_bits(alone, reached.agent)


def test_the_vehicles_of_the_jam_and_of_its_sub_rmdps_move_alike_to_the_bit():
    params = params_of(jam, False)
    subs = jam.sub_rmdps(params)
    model, source = subs["obstacle"].agent, subs["obstacle"].source
    agents, actions = agents_of(model, [[0.5, 0.5], [1.5, 2.0], [2.6, 2.9]])
    rng = np.random.default_rng(8)
    place, turn = rng.uniform(0.1, 2.9, (90, 8, 2)), rng.uniform(-3, 3, (90, 8))
    others = make_vehicle(place, turn, rng.uniform(0, 0.06, (90, 8)))
    states = jam.State(
        agent=agents,
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

    alone = jax.jit(jax.vmap(model.step))(agents, pick(model.actions, actions))
    same_bits(alone, reached.agent)
    same_bits(subs["wall"].agent, model)
    move = jax.jit(jax.vmap(jax.vmap(source.step, (0, None, 0))))
    alone = move(others, agents, controls)
    stayed = ~np.isnan(np.asarray(reached.obstacles.speed))
    assert 0.5 < stayed.mean() < 1
    same_bits(pick(alone, stayed), pick(reached.obstacles, stayed))


@pytest.mark.parametrize("kind", ["wall", "obstacle"])
def test_mirrored_takes_batches(kind):
    source = getattr(jam.make_params(), kind)
    features = jnp.ones((4, 3 if kind == "wall" else 6))
    assert source.mirrored(features).shape == features.shape


def bombs_of(horizon, rows):
    """(sub-R-MDP, agents, bombs) drawn over the window."""
    sub = point_gather.sub_rmdps(point_gather.make_params(horizon=horizon))["bomb"]
    keys = jax.random.split(jax.random.key(2), rows)
    return sub, *jax.jit(jax.vmap(sub.source.sample, (0, None)))(keys, sub.agent)


def quarter_turned(vector):
    return jnp.stack([-vector[..., 1], vector[..., 0]], axis=-1)


def test_bombs_and_their_agents_are_drawn_all_over_the_room():
    _, agents, bombs = bombs_of(15, 8000)
    for places in (agents.position, bombs):
        share = (np.asarray(places) + 6) / 12
        quartiles = np.quantile(share, [0.25, 0.5, 0.75], axis=0).T
        assert (np.abs(quartiles - [0.25, 0.5, 0.75]) < 0.03).all()
    near, agents, bombs = bombs_of(2, 8000)
    far = near.source.window.upper.max()
    assert far < 4
    assert (np.abs(bombs - agents.position) <= far).all()
    assert (np.abs(bombs) <= 6).all()


def test_what_a_point_meets_within_the_horizon_lies_in_the_window(x64):
    sub, agents, _ = bombs_of(4, 2000)
    rng = np.random.default_rng(0)
    chosen = sequences(rng, 2000, 4, 81)
    chosen[:500] = rng.choice([0, 4, 8, 72, 76, 80], (500, 1))  # whole steps
    controls = pick(sub.agent.actions, chosen)
    rim = jnp.asarray(directions(rng, 2000))

    def meet(agent, controls, rim):
        end, _ = jax.lax.scan(lambda v, c: (sub.agent.step(v, c), None), agent, controls)
        bomb = sub.source.centre(end) + (1 - 1e-9) * rim
        return sub.source.hits(end, bomb), sub.source.features(agent, bomb)[:2]

    hit, relative = jax.jit(jax.vmap(meet))(agents, controls, rim)
    assert hit.all()
    assert sub.source.window.contains(relative).all()
    assert relative[:, 0].max() > 0.9 * sub.source.window.upper[0]
    # Nobody turns that far in time: they slide along walls.
    reach = Reach.create(sub.agent.replace(room=None), 4)
    free = reach.box(reach.limits[1]).upper[1] + 1 + point_gather.AHEAD
    assert np.abs(relative[:, 1]).max() > free


def test_a_bomb_is_hit_from_the_centre_of_mass_ahead_of_the_agent():
    source = point_gather.make_params().bomb
    agent = make_vehicle((1.0, 1.0), np.pi / 2, 0.0)
    for away, hit in ((1.04, True), (1.05, False)):
        assert source.hits(agent, jnp.asarray([1.0, 1.0 + away])) == hit
        assert not source.hits(agent, jnp.asarray([1.0, 1.0 - away]))


def test_a_bomb_s_features_name_it_and_the_room_from_the_agent():
    source = point_gather.make_params().bomb
    agent = make_vehicle((5.0, 2.0), np.pi / 2 + 0.1, 0.0)
    found = source.features(agent.replace(heading=jnp.asarray([0.0, 1.0])), jnp.asarray([5.0, 5.0]))
    np.testing.assert_allclose(found, [3, 0, -2, 5, 1, 0], atol=1e-6)
    turned = source.features(agent, jnp.asarray([5.0, 5.0]))
    np.testing.assert_allclose(turned[4:], [np.cos(0.4), np.sin(0.4)], atol=1e-6)


def test_situations_that_look_alike_from_the_sides_of_the_room_have_the_same_features(x64):
    sub, agents, bombs = bombs_of(15, 200)
    features = jax.vmap(sub.source.features)
    found = features(agents, bombs)
    turned = Vehicle(quarter_turned(agents.position), quarter_turned(agents.heading), agents.speed)
    np.testing.assert_allclose(features(turned, quarter_turned(bombs)), found, atol=1e-12)
    again = features(*jax.vmap(sub.source.state_of)(found))
    np.testing.assert_allclose(again, found, atol=1e-12)
    flip = jnp.asarray([[1.0, -1.0]])
    mirrored = Vehicle(agents.position * flip, agents.heading * flip, agents.speed)
    np.testing.assert_allclose(features(mirrored, bombs * flip), sub.source.mirrored(found), atol=0)


def test_mirrored_bombs_threaten_the_mirrored_actions_alike(x64):
    sub, agents, bombs = bombs_of(2, 300)
    features = jax.vmap(sub.source.features)(agents, bombs)
    close = jnp.argsort(jnp.linalg.norm(features[:, :2], axis=-1))[50:100]

    @jax.jit
    def threat(features):
        def one(row):
            return exact_threat(jax.random.key(0), *sub.source.state_of(row), sub).threat

        return jax.lax.map(one, features, batch_size=10)

    here = threat(features[close])
    there = threat(sub.source.mirrored(features[close]))
    assert ((here > 0.01) & (here < 0.9)).any()
    np.testing.assert_allclose(there[:, mirrored_actions(sub.agent.actions)], here, atol=1e-9)


def test_the_agent_of_point_gather_and_of_its_sub_rmdp_move_alike_to_the_bit():
    params = point_gather.make_params()
    sub, agents, _ = bombs_of(15, 90)
    states = jax.vmap(point_gather.reset, (0, None))(
        jax.random.split(jax.random.key(0), 90), params
    )
    actions = jnp.arange(90) % 81
    step = jax.jit(jax.vmap(point_gather.step, (None, 0, 0, None)))
    reached, _ = step(jax.random.key(0), states.replace(agent=agents), actions, params)
    alone = jax.jit(jax.vmap(sub.agent.step))(agents, pick(sub.agent.actions, actions))
    same_bits(alone, reached.agent)
    assert (np.abs(alone.position) == 6).any()  # some come to a wall
