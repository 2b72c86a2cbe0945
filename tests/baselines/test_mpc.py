import functools
import itertools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401

from examples.crossing import world as crossing
from rp_jax import evaluation
from rp_jax.baselines import mpc
from rp_jax.dynamics import angle_of, make_vehicle
from rp_jax.envs import circuit, jam

ENVS = {"circuit": circuit, "jam": jam}
PENALTY = {"circuit": 200.0, "jam": 50.0}


@functools.cache
def params_of(env, **settings):
    return ENVS[env].make_params(**settings)


def search_of(env, horizon, limit=np.inf, **settings):
    return mpc.make_search(ENVS[env], params_of(env, **settings), horizon, PENALTY[env], limit)


@functools.cache
def over(search):
    """A program that searches many states, one after another."""
    return jax.jit(lambda states, given: jax.lax.map(lambda s: search(s, given), states))


exhaustive, pruned = over(mpc.exhaustive), over(mpc.pruned)
follow = jax.jit(mpc.follow)
root = jax.jit(mpc.root)


def rows_of(*states):
    return jax.tree.map(lambda *a: jnp.stack(a), *states)


def crowded(**settings):
    """An agent at full speed in the middle of the room, obstacles within a few steps of it."""
    body = make_vehicle((1.5, 1.5), 0.7, 0.1)
    spots, headings = [(1.78, 1.62), (1.6, 1.9), (2.6, 2.0)], [2.9, -2.2, 0.3]
    others = make_vehicle(spots, headings, [0.06, 0.04, 0.02])
    return jam.start_at(body, others, params_of("jam", num_obstacles=3, **settings))


@functools.cache
def driven(env, count, steps, **settings):
    """States that random driving, mostly forwards, comes by; ended ones are left out."""
    params = params_of(env, **settings)

    def drive(key):
        start, *keys = jax.random.split(key, steps + 1)
        state, over = ENVS[env].reset(start, params), jnp.asarray(False)
        for k in keys:
            action = jax.random.randint(k, (), 5, 15)
            state, outcome = ENVS[env].step(k, state, action, params)
            over |= outcome.terminated
        return state, over

    states, over = jax.jit(jax.vmap(drive))(jax.random.split(jax.random.key(1), count))
    kept = np.flatnonzero(~np.asarray(over))
    return jax.tree.map(lambda a: a[kept], states)


def expected_hits(bodies, state, params):
    """Danger of a path of the agent, one obstacle at a time, by listing all that each may do.

    `agents` are its positions (x + iy) after each step, up to the end of the path.
    """
    behaviour = params.obstacle.behaviour
    turn = lambda v: np.asarray(v, float)[..., 0] + 1j * np.asarray(v, float)[..., 1]  # noqa: E731
    chance, spin = np.asarray(behaviour.probabilities, float), turn(behaviour.controls.rotation)
    push = np.asarray(behaviour.controls.acceleration, float)
    every = np.asarray(list(itertools.product(range(len(chance)), repeat=len(bodies))))
    total = 0.0
    for n in np.flatnonzero(state.present):
        place = np.full(len(every), turn(state.obstacles.position[n]))
        way = np.full(len(every), turn(state.obstacles.heading[n]))
        speed = np.full(len(every), float(state.obstacles.speed[n]))
        hit = np.zeros(len(every), bool)
        for k, body in enumerate(bodies):
            place = place + way * speed
            way, speed = way * spin[every[:, k]], np.clip(speed + push[every[:, k]], 0, 0.06)
            hit |= abs(place - body) < 2 * float(params.radius)
        total += (chance[every].prod(axis=1) * hit).sum()
    return total


def looped(env, state, search):
    """(A,) scores, by trying one sequence after another with the environment's step."""
    step = jax.jit(ENVS[env].step)
    hits = functools.cache(lambda path: expected_hits(path, state, search.params))
    scores = np.full(15, -np.inf)
    for sequence in itertools.product(range(15), repeat=search.horizon):
        at, reward, danger, path = ENVS[env].without_moving_hazards(state), 0.0, 0.0, []
        for action in sequence:
            at, outcome = step(jax.random.key(9), at, action, search.params)
            reward, danger = reward + float(outcome.reward), danger + float(outcome.danger)
            path.append(complex(*np.asarray(at.body.position, float)))
            if outcome.done:
                break
        if env == "jam":
            danger += hits(tuple(path))
        score = reward - float(search.penalty) * danger
        scores[sequence[0]] = max(scores[sequence[0]], score)
    return scores


@pytest.mark.parametrize("sequence", [(12, 12, 12), (10, 2, 0), (4, 3, 7), (14, 14, 5)])
def test_danger_is_the_expectation_over_all_that_each_obstacle_may_do(sequence):
    search, state = search_of("jam", 3, num_obstacles=3), crowded()
    node, path = root(state, search), []
    for action in sequence:
        node = follow(node, action, search)
        path.append(complex(*np.asarray(node.state.body.position, float)))
    expected = expected_hits(path, state, search.params)
    assert 0.01 < expected < 3
    np.testing.assert_allclose(node.danger, expected, atol=1e-5)


def test_absent_obstacles_are_no_danger():
    state = crowded(fidelity="paper")
    search = search_of("jam", 2, num_obstacles=3, fidelity="paper")
    gone = state.replace(present=jnp.asarray([False, False, True]))
    with_all, without = np.asarray(exhaustive(rows_of(state, gone), search))
    assert (without > with_all + 1).any()
    np.testing.assert_allclose(without, looped("jam", gone, search), atol=1e-3)


def test_scores_are_those_of_a_loop_over_all_sequences_on_jam():
    search, state = search_of("jam", 2, num_obstacles=3), crowded()
    near_goal = state.replace(body=make_vehicle((2.6, 2.85), 1.5, 0.1), progress=jnp.asarray(-3.0))
    for start in (state, near_goal):
        expected = looped("jam", start, search)
        np.testing.assert_allclose(exhaustive(rows_of(start), search)[0], expected, atol=1e-3)


@pytest.mark.parametrize("time", [0, 199])
def test_scores_are_those_of_a_loop_over_all_sequences_on_circuit(time):
    search = search_of("circuit", 2)
    state = circuit.start_at(make_vehicle((0.9, 0.12), 0.6, 0.1), search.params)
    state = state.replace(time=jnp.asarray(time, jnp.int32))
    found = np.asarray(exhaustive(rows_of(state), search)[0])
    np.testing.assert_allclose(found, looped("circuit", state, search), atol=1e-3)


def test_before_a_wall_it_turns_away_or_brakes():
    search = search_of("circuit", 4)
    facing = lambda way: circuit.start_at(make_vehicle((0.9, 0.0), way, 0.1), search.params)  # noqa: E731
    left, right, along = np.asarray(
        pruned(rows_of(facing(0.75), facing(-0.75), facing(0.0)), search)
    )
    turn = np.asarray(angle_of(search.params.body.actions.rotation))
    assert turn[left.argmax()] < 0 < turn[right.argmax()]
    assert along.max() == 20  # 4 steps at full speed, a centre point every .02
    assert left.max() > 0  # no crash


def test_an_obstacle_in_the_way_is_avoided():
    search = search_of("jam", 3, num_obstacles=1)
    body = make_vehicle((1.0, 1.0), np.pi / 4, 0.1)
    ahead = make_vehicle([(1.3, 1.3)], [np.pi / 4], [0.0])
    behind = make_vehicle([(0.5, 0.5)], [np.pi / 4], [0.0])
    blocked, free = (jam.start_at(body, other, search.params) for other in (ahead, behind))
    straight = 12
    scores = np.asarray(exhaustive(rows_of(blocked, free), search))
    best = scores.argmax(axis=-1)
    node = root(blocked, search)
    for action in (straight,) * 3:
        node = follow(node, action, search)
    assert node.danger == 1
    assert scores[1, straight] == scores[1].max()
    assert scores[0].max() > -20  # a way around, or a halt
    assert search.params.body.actions.acceleration[best[0]] <= 0 or best[0] != straight


CASES = {
    "circuit, 1": ("circuit", 1, {}, np.inf),
    "circuit, 4": ("circuit", 4, {}, np.inf),
    "circuit, near the end": ("circuit", 3, {"time_limit": 13}, 0.01),
    "jam, 2, as in the text": ("jam", 2, {"num_obstacles": 15, "fidelity": "paper"}, np.inf),
    "jam, 3": ("jam", 3, {"num_obstacles": 3}, np.inf),
    "jam, 3, safe ones first": ("jam", 3, {"num_obstacles": 3}, 0.01),
}


SLOW = ("circuit, 4", "jam, 3", "jam, 2, as in the text")


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.slow] * (case in SLOW)) for case in CASES]
)
def test_pruning_changes_no_choice(case):
    env, horizon, settings, limit = CASES[case]
    states = driven(env, 16, 11, **settings)
    search = search_of(env, horizon, limit, **settings)
    full, some = np.asarray(exhaustive(states, search)), np.asarray(pruned(states, search))
    assert len(full) > 5
    np.testing.assert_allclose(some.max(axis=-1), full.max(axis=-1), rtol=1e-5, atol=1e-4)
    np.testing.assert_array_equal(some.argmax(axis=-1), full.argmax(axis=-1))
    assert (some <= full + 1e-3 + 1e-5 * abs(full)).all()
    if horizon > 1:
        assert (some < full - 0.1).any()  # something was left out


def node_of(reward, danger):
    number = lambda value: jnp.asarray(value, float)  # noqa: E731
    return mpc.Node((), {}, number(reward), number(danger), jnp.asarray(False))


def test_safe_sequences_come_before_all_others():
    search = search_of("jam", 2, limit=0.01)
    score = lambda *node: float(search.score(node_of(*node)))  # noqa: E731
    assert score(3, 0.01) == pytest.approx(2.5)
    assert score(-40, 0.01) > score(40, 0.011)  # safe before rewarding
    assert score(-40, 0.3) > score(40, 0.5)  # of the unsafe, the less dangerous
    assert float(search_of("jam", 2).score(node_of(40, 2.0))) == -60


@pytest.mark.slow
def test_a_row_does_not_depend_on_its_batch():
    settings = {"num_obstacles": 3}
    search, states = search_of("jam", 2, **settings), driven("jam", 12, 11, **settings)
    scores = jax.jit(lambda states, alive: mpc.values(search)(percept(states, alive)))
    everyone = np.ones(states.time.shape, bool)
    together = np.asarray(scores(states, everyone))
    for i in (0, 5):
        one = jax.tree.map(lambda a, i=i: a[i : i + 1], states)
        np.testing.assert_array_equal(scores(one, everyone[:1])[0], together[i])
    some = everyone.copy()
    some[3] = False
    fewer = np.asarray(scores(states, some))
    np.testing.assert_array_equal(fewer[some], together[some])
    assert (fewer[3] == 0).all()  # nobody asked


def test_one_of_the_best_is_drawn_and_no_other():
    states = driven("circuit", 12, 11)
    scores = np.zeros((len(states.time), 15), np.float32)
    scores[:, [2, 7, 11]] = 3.0
    scores[:, 5] = 3.0 - 1e-5  # as good, but for rounding
    draw = jax.jit(jax.vmap(mpc.drawn))
    lots = np.asarray(draw(states, scores))
    best = np.zeros(15, bool)
    best[[2, 5, 7, 11]] = True
    np.testing.assert_array_equal(lots > 0, np.broadcast_to(best, lots.shape))
    np.testing.assert_array_equal(lots, draw(states, scores))  # the same state, the same lot
    later = [np.asarray(draw(states.replace(time=states.time + t), scores)) for t in range(10)]
    winners = np.concatenate([lots.argmax(axis=1) for lots in later])
    shares = [(winners == action).mean() for action in (2, 5, 7, 11)]
    np.testing.assert_allclose(shares, 0.25, atol=0.15)


def percept(states, alive):
    return mpc.Percept(mpc.TrueState(states, alive), None, None, None, None)


def test_parameters_and_penalties_need_no_new_program():
    traced = []

    @jax.jit
    def act(state, search):
        traced.append(1)
        return jnp.argmax(mpc.pruned(state, search))

    state = circuit.demo_start(params_of("circuit"))
    for penalty, limit in [(200.0, np.inf), (1500.0, 0.1)]:
        search = mpc.make_search(circuit, params_of("circuit"), 2, penalty, limit)
        act(state, search)
    assert len(traced) == 1


def test_it_is_evaluated_as_any_policy():
    search = search_of("jam", 2, num_obstacles=3, time_limit=6)
    run = jax.jit(
        lambda key, pmdp: evaluation.run_episodes(key, pmdp, mpc.values(search), 8, batch=4)
    )
    rows = run(jax.random.key(0), mpc.omniscient(search))
    assert rows.length.shape == (8,)
    assert (rows.length[rows.danger == 0] == 6).all()
    assert (rows.interventions == 0).all()
    assert (rows.insecure == 0).all()


def test_the_state_is_seen_by_nobody_else():
    search = search_of("jam", 2, num_obstacles=3)
    states = rows_of(crowded())
    seen = mpc.omniscient(search).perceive(states).encoded
    assert isinstance(seen, mpc.TrueState)
    np.testing.assert_array_equal(seen.states.obstacles.position, states.obstacles.position)
    assert seen.alive.all()
    plain = mpc.PMDP(
        **{f: getattr(mpc.omniscient(search), f) for f in mpc.PMDP.__dataclass_fields__}
    )
    assert plain.perceive(states).encoded._fields == ("scan", "rest")


@pytest.mark.parametrize("env", ENVS)
def test_alone_nothing_is_random(env):
    params = params_of(env)
    states = driven(env, 16, 11)

    @jax.jit
    @jax.vmap
    def both(state):
        lone = ENVS[env].without_moving_hazards(state)
        keys = jax.random.key(0), jax.random.key(7)
        return [ENVS[env].step(key, lone, 14, params) for key in keys]

    (one, first), (other, second) = jax.device_get(both(states))
    for a, b in zip(
        jax.tree.leaves((one.body, first)), jax.tree.leaves((other.body, second)), strict=True
    ):
        np.testing.assert_array_equal(a, b)


def test_no_danger_above_the_limit_counts_as_safe_by_rounding_it():
    for limit in (0.001, 0.01, np.inf):  # the nearest float32 to .001 is above it
        found = float(mpc.make_search(jam, params_of("jam"), 2, 50.0, limit).limit)
        assert found <= limit <= float(np.nextafter(np.float32(found), np.float32(np.inf)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ((0, 50.0), "^horizon is 0; it must be an integer, at least 1"),
        ((2.5, 50.0), r"^horizon is 2\.5; it must be an integer"),
        ((9, 50.0), "^horizon is 9; it must be .* at most 6"),
        ((2, -1.0), r"^penalty is -1\.0; it must be a finite number, at least 0"),
        ((2, 50.0, np.nan), "^limit is nan; it must be a number, at least 0"),
    ],
)
def test_settings_out_of_range_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        mpc.make_search(jam, params_of("jam"), *settings)


def test_what_a_world_of_ones_own_lacks_for_a_search_is_named():
    params = crossing.make_params()
    says = r"model is .*; it must have without_moving_hazards\(state\)"
    with pytest.raises(ValueError, match=says):
        mpc.make_search(crossing, params, 2, 50.0)
    alone = types.SimpleNamespace(**vars(crossing), without_moving_hazards=lambda state: state)
    with pytest.raises(ValueError, match="source of 'pedestrian' has no `behaviour`"):
        mpc.make_search(alone, params, 2, 50.0)
