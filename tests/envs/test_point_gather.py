import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rp_jax.envs import point_gather
from rp_jax.recon.labels import exact_threat

STRAIGHT, STAY, LEFT = 76, 40, 80  # a whole step, none, a whole step with the hardest turn
FAR = [[5.0, 5.0], [5.0, -5.0]]
step = jax.jit(jax.vmap(point_gather.step, (None, 0, 0, None)))
observe = jax.jit(point_gather.observe)
reset = jax.jit(jax.vmap(point_gather.reset, (0, None)))


@functools.lru_cache
def params_of(fidelity="released", double=False):
    assert double == jax.config.jax_enable_x64
    return point_gather.make_params(fidelity=fidelity)


def at(position=(0.0, 0.0), angle=0.0, apples=(), bombs=()):
    """A state with two apples and two bombs: those given, and others far off."""
    apples, bombs = ([*map(list, some), *FAR][:2] for some in (apples, bombs))
    places = [jnp.asarray(some, float) for some in (position, apples, bombs)]
    return point_gather.start_at(places[0], angle, *places[1:])


def after(state, *actions, fidelity="released"):
    """(state, outcome) after some actions, from one compilation."""
    params = params_of(fidelity)
    for action in actions:
        one = jax.tree.map(lambda a: a[None], state)
        key = jax.random.key(0)
        both = step(key, one, jnp.asarray([action]), params)
        state, outcome = jax.tree.map(lambda a: a[0], both)
    return state, outcome


def test_a_step_turns_first_and_then_goes_along_the_new_heading():
    reached, _ = after(at(angle=0.5), LEFT)
    expected = [np.cos(0.75), np.sin(0.75)]
    np.testing.assert_allclose(reached.body.position, expected, atol=1e-6)
    np.testing.assert_allclose(reached.body.heading, expected, atol=1e-6)
    assert reached.body.speed == 0
    back, _ = after(reached, 4)  # a whole step back, without a turn
    np.testing.assert_allclose(back.body.position, [0, 0], atol=1e-6)


def test_turns_add_up_to_more_than_a_full_one():
    reached, _ = after(at(angle=3.0), *[44] * 20)  # on the spot, to the left
    np.testing.assert_allclose(reached.angle, 8.0, atol=1e-5)
    np.testing.assert_allclose(reached.body.heading, [np.cos(8), np.sin(8)], atol=1e-5)
    assert observe(reached, params_of())[2] == reached.angle


def test_walls_hold_the_agent_who_slides_along_them():
    reached, _ = after(at((5.8, 1.0), np.pi / 4), STRAIGHT)
    np.testing.assert_allclose(reached.body.position, [6.0, 1 + np.sqrt(0.5)], atol=1e-6)


@pytest.mark.parametrize(("fidelity", "ahead"), [("released", point_gather.AHEAD), ("paper", 0.0)])
@pytest.mark.parametrize("short", [1e-4, -1e-4])
def test_objects_are_collected_from_nearer_than_one(fidelity, ahead, short):
    place = [2.0 + ahead - short, 0.0]
    reached, outcome = after(at(apples=[place], bombs=[place]), STRAIGHT, fidelity=fidelity)
    taken = short > 0
    assert (outcome.reward, outcome.danger) == (10.0 * taken, taken)
    np.testing.assert_array_equal(reached.apples.present, [not taken, True])
    np.testing.assert_array_equal(reached.bombs.present, [not taken, True])
    assert reached.hit == taken
    assert not outcome.terminated


def test_every_bomb_is_counted_once_and_several_at_once():
    bombs = [[1.5, 0.3], [1.5, -0.3]]
    reached, outcome = after(at(bombs=bombs), STRAIGHT)
    assert outcome.danger == 2
    assert not reached.bombs.present.any()
    again, outcome = after(reached, STAY)
    assert outcome.danger == 0
    assert not again.hit


def test_the_episode_ends_when_nothing_is_left():
    state = at(apples=[[1.5, 0.0]] * 2, bombs=[[1.0, 0.0]] * 2)
    _, outcome = after(state, STRAIGHT)
    assert (outcome.reward, outcome.danger) == (20.0, 2.0)
    assert outcome.terminated
    assert not outcome.truncated
    _, outcome = after(at(bombs=[[1.0, 0.0]] * 2).replace(time=jnp.int32(14)), STRAIGHT)
    assert outcome.truncated  # two apples are left
    assert not outcome.terminated


def test_starts_spread_the_objects_over_the_cells_without_the_middle():
    count = 4000
    states = reset(jax.random.split(jax.random.key(0), count), params_of())
    apples, bombs = np.asarray(states.apples.position), np.asarray(states.bombs.position)
    assert apples.shape == (count, 2, 2)
    assert bombs.shape == (count, 8, 2)
    cells = np.concatenate([apples, bombs], axis=1) @ [10.0, 1.0]
    assert all(len(set(row)) == 10 for row in cells.tolist())
    known = point_gather.cells() @ [10.0, 1.0]
    for some in (cells[:, 0], cells[:, 9]):
        found = [np.sum(some == cell) for cell in known]
        assert sum(found) == count
        assert stats.chisquare(found).pvalue > 1e-4
    assert states.apples.present.all()
    pose = np.concatenate([states.body.position, states.angle[:, None]], axis=-1)
    for values, spread in ((pose, 0.01), (np.asarray(states.velocity), 0.1)):
        np.testing.assert_allclose(values.std(axis=0), spread, rtol=0.05)
        assert (np.abs(values.mean(axis=0)) < 0.1 * spread).all()


def test_recorded_starts_lie_in_the_same_cells(golden):
    recorded = golden("traces_gather")["reset_objects"][..., :2].reshape(-1, 2)
    assert {tuple(cell) for cell in recorded} == {tuple(cell) for cell in point_gather.cells()}


def readings(**places):
    """(apples, bombs) seen by a point mass in the middle that faces along x."""
    seen = np.asarray(observe(at(**places), params_of("paper")))
    return seen[9:19], seen[19:]


def ray(degrees, distance):
    angle = np.radians(degrees)
    return [distance * np.cos(angle), distance * np.sin(angle)]


def test_sensors_see_the_nearest_of_each_bin_in_front():
    apples, bombs = readings(apples=[ray(-80, 3.0), ray(-75, 1.5)], bombs=[ray(80, 6.0), ray(5, 3)])
    np.testing.assert_allclose(apples, [0.75, *[0] * 9], atol=1e-6)
    np.testing.assert_allclose(bombs, [0, 0, 0, 0, 0, 0.5, 0, 0, 0, 0], atol=1e-6)


@pytest.mark.parametrize("place", [ray(95, 1.5), ray(180, 2.0), ray(-91, 3.0), ray(10, 6.01)])
def test_sensors_do_not_see_behind_or_far_away(place):
    apples, bombs = readings(apples=[place, place], bombs=[place, place])
    assert not apples.any()
    assert not bombs.any()


@pytest.mark.parametrize("k", range(10))
def test_every_bin_is_eighteen_degrees_wide(k):
    ends = (18 * k - 89.99, 18 * k - 72.01)
    for degrees in ends:
        apples, _ = readings(apples=[ray(degrees, 3.0)] * 2)
        np.testing.assert_array_equal(apples > 0, np.arange(10) == k)


def test_what_is_collected_is_seen_no_more():
    state = at(apples=[ray(5, 1.9), ray(5, 4)])
    seen = observe(state, params_of())[14]
    reached, outcome = after(state, STRAIGHT)
    assert outcome.reward == 10
    assert seen > 0.5
    np.testing.assert_allclose(observe(reached, params_of())[14], 0.5, atol=0.03)


def test_the_observation_names_pose_velocity_and_centre_of_mass():
    state = at((1.0, 2.0), 0.5).replace(velocity=jnp.asarray([0.1, 0.2, 0.3]))
    ahead = point_gather.AHEAD
    expected = [1, 2, 0.5, 0.1, 0.2, 0.3, 1 + ahead * np.cos(0.5), 2 + ahead * np.sin(0.5), 0.5]
    np.testing.assert_allclose(observe(state, params_of())[:9], expected, atol=1e-6)


@pytest.mark.parametrize("position", [(0.0, 0.0), (5.2, -5.5)])
def test_the_threat_is_equal_to_the_sum_over_bombs(position, x64):
    """The expected discounted bombs of an action and a baseline step, by enumeration."""
    params = point_gather.make_params(2, 3, horizon=2)
    bombs = jnp.asarray(position + np.asarray([[1.5, 0.4], [1.7, -0.6], [-1.2, 0.5]]))
    state = point_gather.start_at(jnp.asarray(position), 0.4, jnp.asarray(FAR), bombs)
    baseline, beta = params.body.baseline, params.beta
    every, key = jnp.arange(81), jax.random.key(0)

    def both(first):
        reached, begun = point_gather.step(key, state, first, params)
        # The baseline draws from the same table as the actions.
        ended = jax.vmap(lambda a: point_gather.step(key, reached, a, params)[1].danger)(every)
        return beta * begun.danger + beta**2 * jnp.sum(baseline.probabilities * ended)

    jax.tree.map(np.testing.assert_array_equal, baseline.controls, params.body.actions)
    truth = jax.jit(jax.vmap(both))(every)
    sub = point_gather.sub_rmdps(params)["bomb"]
    alone = jax.jit(jax.vmap(exact_threat, (None, None, 0, None)))(key, state.body, bombs, sub)
    assert truth.min() < 0.5 < truth.max()
    assert (alone.threat > 0.01).any(axis=1).all()
    np.testing.assert_allclose(alone.threat.sum(axis=0), truth, atol=1e-9)


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("num_apples", (-1, 28, 35, 1.5)),
        ("num_bombs", (0, 34, -2)),
        ("time_limit", (0, 1.5)),
        ("horizon", (0, 101)),
        ("beta", (0.0, 1.1)),
        ("fidelity", ("text",)),
    ],
)
def test_parameters_out_of_range_are_named(field, values):
    for value in values:
        with pytest.raises(ValueError, match=rf"^{field} is .*; it must be"):
            point_gather.make_params(**{field: value})


@pytest.mark.parametrize(("apples", "bombs"), [(0, 1), (34, 1), (0, 35), (5, 20)])
def test_rooms_hold_any_number_of_objects(apples, bombs):
    params = point_gather.make_params(apples, bombs)
    state = point_gather.reset(jax.random.key(1), params)
    assert len(state.apples.position) == apples
    assert len(state.bombs.position) == bombs
    assert point_gather.observe(state, params).shape == (29,)
    assert np.isfinite(point_gather.observe(state, params)).all()
