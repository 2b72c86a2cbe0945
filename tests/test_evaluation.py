import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from quick import compile_soon  # noqa: F401
from scipy import stats
from shields import PROBE, at, eager, narrow

from rp_jax import evaluation
from rp_jax.evaluation import Episodes


def scatter(rest, actions):
    """(B, A) values that differ from state to state."""
    phase = jnp.arange(1.0, actions + 1)[None] * 1.7
    return jnp.sin(phase * jnp.sum(rest * 2.3, axis=-1, keepdims=True))


def wander(percept):
    return scatter(percept.encoded.rest + 0.4, 3)


def steer(percept):
    return scatter(percept.encoded.rest, 15)


POLICIES = {
    "probe, at random": (at(0.5), wander),
    "probe, to the pit": (at(0.5), eager),
    "probe, no shield": (at(np.inf), wander),
    "probe, never secure": (at(-1.0), wander),
    "circuit": (narrow, steer),
}
run = jax.jit(evaluation.run_episodes, static_argnums=(2, 3), static_argnames="batch")


def by_hand(key, pmdp, values, episodes, batch):
    """The same, one step and one episode after another."""
    env, rows = pmdp.env, []
    step, reset = jax.jit(env.step), jax.jit(env.reset)
    look, hit = jax.jit(pmdp.perceive), jax.jit(env.collisions)
    for round_key in jax.random.split(key, -(-episodes // batch)):
        start_key, play_key = jax.random.split(round_key)
        _, step_key = jax.random.split(play_key)  # the first is the policy's, which needs none
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
            row["collisions"] = {k: bool(v) for k, v in hit(state, pmdp.params).items()}
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
    for kind, hit in found.collisions.items():
        np.testing.assert_array_equal(hit, [row["collisions"][kind] for row in expected])
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
    assert free.danger.sum() == free.collisions["pit"].sum() == 11
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
        booked=jnp.zeros(len(score)),
        collisions={"pit": jnp.asarray(pit, bool), "wall": jnp.zeros(len(score), bool)},
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
    found = evaluation.summarise(rows, 50.0)
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
    assert found["collisions"] == {"pit": 1, "wall": 0}  # the last episode did not crash


def test_a_summary_without_crashes_says_what_is_excluded():
    rows = made([1.0] * 100, [0] * 100, [0] * 100, [5] * 100, [0] * 100, [0] * 100, [0] * 100)
    found = evaluation.summarise(rows, 50.0)
    assert found["crash_rate"] == found["crashes"] == 0
    assert found["crash_upper95"] == pytest.approx(1 - 0.05**0.01)
    np.testing.assert_allclose(found["crash_ci95"], [0, 1 - 0.025**0.01])
    assert found["return_mean"] == found["uncrashed_return_mean"] == 1
    assert found["return_ci95"] == 0


def test_an_episode_of_several_bombs_is_one_crash_and_more_danger():
    rows = made([20, 10, 0, 0], [3, 0, 1, 0], [0] * 4, [15] * 4, [0] * 4, [0] * 4, [1, 0, 1, 0])
    found = evaluation.summarise(rows, 2.0)
    assert found["crashes"] == 2
    assert found["danger_mean"] == 1.0
    assert found["return_mean"] == (14 + 10 - 2) / 4
    assert found["danger_ci95"] == pytest.approx(stats.t.ppf(0.975, 3) * np.sqrt(2) / 2)
    assert found["collisions"]["pit"] == 2


def test_a_summary_of_crashes_alone_or_of_one_episode():
    all_crashed = made([1, 2], [1, 1], [0, 0], [5, 5], [0, 0], [0, 0], [1, 1])
    found = evaluation.summarise(all_crashed, 10.0)
    assert found["crash_rate"] == 1
    assert found["crash_upper95"] == found["crash_ci95"][1] == 1
    assert np.isnan(found["uncrashed_return_mean"])
    assert found["return_mean"] == -8.5
    one = jax.tree.map(lambda a: a[:1], all_crashed)
    assert np.isnan(evaluation.summarise(one, 0.0)["return_ci95"])


def test_learned_values_are_those_of_the_network():
    class Net:
        @staticmethod
        def apply(weights, encoded):
            return weights * encoded.rest[:, :1]

    percept = jax.jit(PROBE.perceive)(jax.vmap(probe.start_at)(jnp.asarray([2.0, 5.0])))
    np.testing.assert_array_equal(evaluation.action_values(Net, 3.0)(percept), [[6.0], [15.0]])
