import functools

import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from quick import compile_soon  # noqa: F401
from scipy import stats

from rp_jax import evaluate
from rp_jax.envs import circuit
from rp_jax.evaluate import Episodes

PROBE = probe.make_pmdp(probe, probe.make_params(slip=0.2))


@functools.cache
def narrow():
    """Circuit with a shield of untrained weights, so that it interferes at random."""
    params = circuit.make_params("circle", time_limit=25)
    model = probe.threat_model(probe.make_params())
    network = model.network.clone(num_actions=15)
    rng = np.random.default_rng(0)
    kernel, bias = rng.normal(0, 8, (3, 15)), rng.normal(-2, 1, 15)
    weights = {"kernel": jnp.asarray(kernel, jnp.float32), "bias": jnp.asarray(bias, jnp.float32)}
    wall = model.replace(
        source=params.wall, params={"params": {"Dense_0": weights}}, network=network
    )
    return probe.make_pmdp(circuit, params, 0.3, models={"wall": wall})


def scatter(rest, actions):
    """(B, A) values that differ from state to state."""
    phase = jnp.arange(1.0, actions + 1)[None] * 1.7
    return jnp.sin(phase * jnp.sum(rest * 2.3, axis=-1, keepdims=True))


def eager(percept):
    """Prefers the right, where the pit is, then the left."""
    return jnp.tile(jnp.asarray([[0.0, 1.0, 2.0]]), (percept.secure.shape[0], 1))


def wander(percept):
    return scatter(percept.encoded.rest + 0.4, 3)


def steer(percept):
    return scatter(percept.encoded.rest, 15)


def at(x):
    return lambda: PROBE.replace(x=jnp.asarray(x, jnp.float32))


POLICIES = {
    "probe, at random": (at(0.5), wander),
    "probe, to the pit": (at(0.5), eager),
    "probe, no shield": (at(np.inf), wander),
    "probe, never secure": (at(-1.0), wander),
    "circuit": (narrow, steer),
}
run = jax.jit(evaluate.run_episodes, static_argnums=(2, 3), static_argnames="batch")


def by_hand(key, pmdp, values, episodes, batch):
    """The same, one step and one episode after another."""
    env, rows = pmdp.env, []
    step, reset = jax.jit(env.step), jax.jit(env.reset)
    look, hit = jax.jit(pmdp.perceive), jax.jit(env.causes)
    for round_key in jax.random.split(key, -(-episodes // batch)):
        start_key, step_key = jax.random.split(round_key)
        for begin, onward in zip(
            *(jax.random.split(k, batch) for k in (start_key, step_key)), strict=True
        ):
            state = reset(begin, pmdp.params)
            row = dict.fromkeys(("score", "danger", "length", "interventions", "insecure"), 0.0)
            done = False
            while not done:
                percept = look(jax.tree.map(lambda a: a[None], state))
                scores = np.asarray(values(percept))[0]
                allowed = np.asarray(percept.admissible)[0]
                action = max(np.flatnonzero(allowed), key=lambda a: scores[a])
                now = jax.random.fold_in(onward, int(row["length"]))
                state, outcome = step(now, state, jnp.asarray(action), pmdp.params)
                row["score"] += float(outcome.reward)
                row["danger"] += float(outcome.danger)
                row["length"] += 1
                row["interventions"] += action != scores.argmax()
                row["insecure"] += not percept.secure[0]
                done = bool(outcome.terminated | outcome.truncated)
            row["goal"] = bool(outcome.goal)
            row["causes"] = {k: bool(v) for k, v in hit(state, pmdp.params).items()}
            rows.append(row)
    return rows[:episodes]


@pytest.mark.parametrize("name", POLICIES)
def test_episodes_count_what_a_slow_loop_counts(name):
    make, values = POLICIES[name]
    pmdp, key = make(), jax.random.key(3)
    found = run(key, pmdp, values, 11, batch=4)
    expected = by_hand(key, pmdp, values, 11, 4)
    for field in ("score", "danger", "length", "interventions", "insecure", "goal"):
        wanted = np.asarray([row[field] for row in expected], float)
        np.testing.assert_allclose(getattr(found, field), wanted, atol=1e-4, err_msg=field)
    for kind, hit in found.causes.items():
        np.testing.assert_array_equal(hit, [row["causes"][kind] for row in expected])
    # The trial is a fair one.
    assert (found.interventions.sum() > 0) == (name != "probe, no shield")
    if name == "probe, no shield":
        assert 0 < found.danger.sum() < 11
    if name == "probe, never secure":
        np.testing.assert_array_equal(found.insecure, found.length)
    if name == "circuit":
        assert 0 < found.insecure.sum() < found.length.sum()
        assert len(np.unique(found.length)) > 2


def test_the_shield_holds_the_eager_back():
    rows = run(jax.random.key(0), PROBE, eager, 11, batch=4)
    assert rows.danger.sum() == 0
    assert (rows.length == 12).all()  # it waits beside the pit until the time is up
    assert (rows.interventions > 0).all()
    free = run(jax.random.key(0), at(np.inf)(), eager, 11, batch=4)
    assert free.danger.sum() == free.causes["pit"].sum() == 11
    assert free.interventions.sum() == 0
    np.testing.assert_array_equal(free.score, 3.0)


def test_the_same_key_gives_the_same_episodes_and_another_round_others():
    one, two, other = (run(jax.random.key(k), PROBE, wander, 11, batch=4) for k in (1, 1, 2))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one.length, other.length)
    assert not np.array_equal(one.length[:4], one.length[4:8])


def test_more_places_than_episodes_do_no_harm():
    rows = run(jax.random.key(5), PROBE, eager, 3, batch=50)
    assert all(leaf.shape == (3,) for leaf in jax.tree.leaves(rows))
    assert (rows.length == 12).all()


def made(score, danger, goal, length, interventions, insecure, pit):
    return Episodes(
        score=jnp.asarray(score, float),
        danger=jnp.asarray(danger, float),
        goal=jnp.asarray(goal, bool),
        length=jnp.asarray(length),
        interventions=jnp.asarray(interventions),
        insecure=jnp.asarray(insecure),
        causes={"pit": jnp.asarray(pit, bool), "wall": jnp.zeros(len(score), bool)},
        bad_observations=jnp.zeros(len(score)),
        bad_threats=jnp.zeros(len(score)),
    )


def test_the_summary_by_hand():
    rows = made(
        [1, 2, 3, 10],
        [0, 1, 0, 0],
        [1, 0, 0, 1],
        [5, 5, 6, 4],
        [2, 0, 1, 2],
        [0, 4, 0, 0],
        [0, 1, 0, 1],
    )
    found = evaluate.summarise(rows, 50.0)
    returns = np.asarray([1, -48, 3, 10.0])
    width = stats.t.ppf(0.975, 3) * returns.std(ddof=1) / 2
    low, high = stats.beta.ppf([0.025, 0.975], [1, 2], [4, 3])
    assert found["episodes"] == 4
    assert found["return_mean"] == pytest.approx(returns.mean())
    assert found["return_ci95"] == pytest.approx(width)
    assert found["uncrashed_return_mean"] == pytest.approx(14 / 3)
    assert found["crashes"] == 1
    assert found["crash_rate"] == 0.25
    np.testing.assert_allclose(found["crash_ci95"], [low, high])
    assert found["crash_upper95"] == pytest.approx(stats.beta.ppf(0.95, 2, 3))
    assert found["goal_rate"] == 0.5
    assert found["steps"] == 20
    assert found["interventions"] == pytest.approx(5 / 20)
    assert found["insecure"] == pytest.approx(4 / 20)
    assert found["causes"] == {"pit": 1, "wall": 0}  # the last episode did not crash


def test_a_summary_without_crashes_says_what_is_excluded():
    rows = made([1.0] * 100, [0] * 100, [0] * 100, [5] * 100, [0] * 100, [0] * 100, [0] * 100)
    found = evaluate.summarise(rows, 50.0)
    assert found["crash_rate"] == found["crashes"] == 0
    assert found["crash_upper95"] == pytest.approx(1 - 0.05**0.01)
    np.testing.assert_allclose(found["crash_ci95"], [0, 1 - 0.025**0.01])
    assert found["return_mean"] == found["uncrashed_return_mean"] == 1
    assert found["return_ci95"] == 0


def test_an_episode_of_several_bombs_is_one_crash_and_more_danger():
    rows = made([20, 10, 0, 0], [3, 0, 1, 0], [0] * 4, [15] * 4, [0] * 4, [0] * 4, [1, 0, 1, 0])
    found = evaluate.summarise(rows, 2.0)
    assert found["crashes"] == 2
    assert found["danger_mean"] == 1.0
    assert found["return_mean"] == (14 + 10 - 2) / 4
    assert found["danger_ci95"] == pytest.approx(stats.t.ppf(0.975, 3) * np.sqrt(2) / 2)
    assert found["causes"]["pit"] == 2


def test_a_summary_of_crashes_alone_or_of_one_episode():
    all_crashed = made([1, 2], [1, 1], [0, 0], [5, 5], [0, 0], [0, 0], [1, 1])
    found = evaluate.summarise(all_crashed, 10.0)
    assert found["crash_rate"] == 1
    assert found["crash_upper95"] == found["crash_ci95"][1] == 1
    assert np.isnan(found["uncrashed_return_mean"])
    assert found["return_mean"] == -8.5
    one = jax.tree.map(lambda a: a[:1], all_crashed)
    assert np.isnan(evaluate.summarise(one, 0.0)["return_ci95"])


def test_learned_values_are_those_of_the_network():
    class Net:
        @staticmethod
        def apply(weights, encoded):
            return weights * encoded.rest[:, :1]

    percept = jax.jit(PROBE.perceive)(jax.vmap(probe.start_at)(jnp.asarray([2.0, 5.0])))
    np.testing.assert_array_equal(evaluate.action_values(Net, 3.0)(percept), [[6.0], [15.0]])


@functools.cache
def recorded():
    still = at(np.inf)().replace(params=probe.make_params(slip=0.0))
    starts = jax.vmap(probe.start_at)(jnp.asarray([4.0, 1.0, 3.0]))

    def values(percept):
        left = jnp.asarray([[0.0, 1.0, 0.0]])
        return jnp.where(percept.encoded.rest[:, :1] == 1.0, left, eager(percept))

    record = jax.jit(evaluate.record, static_argnums=(2, 4))
    return record(jax.random.key(0), still, values, starts, 5)


def test_a_recording_shows_every_step_and_then_the_end():
    shown = recorded()
    cells = np.asarray(shown.states.agent.position[..., 0]).T
    # Two walk into the pit at 6 and stay there; one takes the coin at 0 at once.
    np.testing.assert_array_equal(cells, [[4, 5, 6, 6, 6], [1, 0, 0, 0, 0], [3, 4, 5, 6, 6]])
    alive = [[1, 1, 0, 0, 0], [1, 0, 0, 0, 0], [1, 1, 1, 0, 0]]
    np.testing.assert_array_equal(shown.alive.T, alive)
    np.testing.assert_array_equal(
        shown.states.time.T, [[0, 1, 2, 2, 2], [0, 1, 1, 1, 1], [0, 1, 2, 3, 3]]
    )
    np.testing.assert_array_equal(shown.action[:2, 0], [probe.RIGHT, probe.RIGHT])
    assert shown.action[0, 1] == probe.LEFT


def test_a_recording_keeps_the_threats_at_each_step():
    shown = recorded()
    assert shown.threat.shape == shown.admissible.shape == (5, 3, 3)
    beside = np.asarray(shown.states.agent.position[..., 0]) == 5
    np.testing.assert_allclose(shown.threat[beside], [[0, 0, 1]] * 2, atol=1e-6)
    assert shown.admissible.all()
    assert shown.secure.all()


visit = jax.jit(evaluate.visited_states, static_argnums=(2, 3))


def test_visited_states_are_many_and_under_way():
    states = visit(jax.random.key(0), PROBE, 400, 10)
    cells, times = np.asarray(states.agent.position[:, 0]), np.asarray(states.time)
    assert cells.shape == times.shape == (400,)
    assert set(np.unique(cells)) == {1, 2, 3, 4, 5}  # none has ended
    assert set(np.unique(times)) == set(range(10))
    other = visit(jax.random.key(1), PROBE, 400, 10)
    assert not np.array_equal(cells, other.agent.position[:, 0])


def test_visited_states_are_reached_by_admissible_actions_only():
    states = visit(jax.random.key(2), at(-1.0)(), 400, 10)
    # Where nothing is admissible, the least threatening of equals is the first: to stay.
    assert set(np.unique(states.agent.position[:, 0])) == set(probe.STARTS)


def test_visited_states_of_circuit_lie_on_the_track():
    pmdp = narrow()
    states = visit(jax.random.key(3), pmdp, 30, 20)
    crashed = jax.jit(jax.vmap(circuit.causes, (0, None)))(states, pmdp.params)["wall"]
    assert not crashed.any()
    assert len(np.unique(states.agent.position[:, 0])) == 30
    assert states.time.max() > 10
