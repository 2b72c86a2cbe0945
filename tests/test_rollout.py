"""The loop of episodes, by hand on the corridor: a coin at cell 0, a pit at 6, nobody slips."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from quick import compile_soon  # noqa: F401

from rp_jax import recording, shield
from rp_jax.envs.contract import Outcome
from rp_jax.rollout import Step, rollout

STILL = probe.make_pmdp(probe, probe.make_params(slip=0.0), x=np.inf)
SHORT = STILL.replace(params=probe.make_params(slip=0.0, time_limit=4))
LEFT, RIGHT = probe.LEFT, probe.RIGHT
STEPS = 12  # the time limit of the corridor


def at(*cells):
    return jax.vmap(probe.start_at)(jnp.asarray(cells, float))


def cells_of(states):
    return np.asarray(states.body.position[..., 0])


def walk(_, percept):
    """To the right, but from cell 1 to the left, which it calls a change."""
    first = percept.encoded.rest[:, 0] == 1
    return jnp.where(first, LEFT, RIGHT), first


def keep(tape, step):
    """Writes down every step."""
    return jax.tree.map(lambda rows, row: rows.at[step.time].set(row), tape, step)


def blank(world, states, action=int):
    """A tape of nothing but -1."""
    count = len(jax.tree.leaves(states)[0])
    flags = jnp.zeros(count, bool)
    actions = jnp.zeros(count, action)

    def first():
        percept = world.perceive(states)
        keys = jax.random.split(jax.random.key(0), count)
        reached, outcome = world.advance(keys, states, actions, percept)
        time = jnp.asarray(0)
        return Step(time, flags, flags, states, percept, actions, flags, reached, outcome)

    shapes = jax.eval_shape(first)
    return jax.tree.map(lambda a: jnp.full((STEPS, *a.shape), -1).astype(a.dtype), shapes)


def taped(world, *cells, policy=walk, key=0, **options):
    """(last states, the steps as a slow loop would note them), jitted."""
    states = at(*cells)

    @jax.jit
    def play(key, world, states):
        return rollout(key, world, policy, states, keep, blank(world, states), **options)

    end, tape = jax.device_get(play(jax.random.key(key), world, states))
    made = int((tape.time >= 0).sum())
    return end, jax.tree.map(lambda a: a[:made], tape)


def test_it_plays_until_every_episode_has_ended():
    end, tape = taped(STILL, 4, 1, 3)
    np.testing.assert_array_equal(tape.time, [0, 1, 2])  # folded three times, in order
    np.testing.assert_array_equal(tape.alive.T, [[1, 1, 0], [1, 0, 0], [1, 1, 1]])
    np.testing.assert_array_equal(tape.moved, tape.alive)
    np.testing.assert_array_equal(cells_of(end), [6, 0, 6])
    np.testing.assert_array_equal(end.time, [2, 1, 3])


def test_a_step_shows_what_was_what_was_done_and_what_came_of_it():
    _, tape = taped(STILL, 4, 1, 3)
    np.testing.assert_array_equal(cells_of(tape.states).T, [[4, 5, 6], [1, 0, 0], [3, 4, 5]])
    np.testing.assert_array_equal(tape.states.time.T, [[0, 1, 2], [0, 1, 1], [0, 1, 2]])
    np.testing.assert_array_equal(tape.percept.encoded.rest[..., 0], cells_of(tape.states))
    np.testing.assert_array_equal(tape.action.T, [[RIGHT] * 3, [LEFT, RIGHT, RIGHT], [RIGHT] * 3])
    np.testing.assert_array_equal(tape.changed.T, [[0, 0, 0], [1, 0, 0], [0, 0, 0]])
    moved = tape.moved
    np.testing.assert_array_equal(cells_of(tape.reached)[moved], [5, 0, 4, 6, 5, 6])
    np.testing.assert_array_equal(tape.outcome.reward[moved], [0, 1, 0, 3, 0, 3])
    np.testing.assert_array_equal(tape.outcome.danger[moved], [0, 0, 0, 1, 0, 1])
    np.testing.assert_array_equal(tape.outcome.goal[moved], [0, 1, 0, 0, 0, 0])
    np.testing.assert_array_equal(tape.outcome.terminated[moved], [0, 1, 0, 1, 0, 1])


def test_what_a_fold_carries_is_given_on_from_step_to_step():
    def fold(carry, step):
        calls, score = carry
        return calls + 1, score + jnp.where(step.moved, step.outcome.reward, 0.0)

    first = jnp.asarray(10), jnp.asarray([0.5, 0.0, 0.0])
    play = jax.jit(lambda world: rollout(jax.random.key(0), world, walk, at(4, 1, 3), fold, first))
    _, (calls, score) = play(STILL)
    assert calls == 10 + 3
    np.testing.assert_array_equal(score, [3.5, 1, 3])


def test_the_time_limit_ends_an_episode_as_well():
    end, tape = taped(SHORT, 1.5, 4)  # from 1.5 the pit is not reached within 4 steps
    np.testing.assert_array_equal(cells_of(end), [5.5, 6])
    np.testing.assert_array_equal(tape.moved.T, [[1, 1, 1, 1], [1, 1, 0, 0]])
    np.testing.assert_array_equal(tape.outcome.truncated[:, 0], [0, 0, 0, 1])


def test_rows_that_are_not_alive_stay_where_they_are():
    end, tape = taped(STILL, 4, 1, 3, alive=jnp.asarray([False, True, False]))
    np.testing.assert_array_equal(cells_of(end), [4, 0, 3])
    np.testing.assert_array_equal(end.time, [0, 1, 0])
    np.testing.assert_array_equal(tape.time, [0])  # nor is anything waited for
    np.testing.assert_array_equal(tape.alive, [[0, 1, 0]])
    np.testing.assert_array_equal(tape.moved, [[0, 1, 0]])


def test_with_nobody_alive_nothing_is_done():
    end, tape = taped(STILL, 4, 1, alive=jnp.zeros(2, bool))
    np.testing.assert_array_equal(cells_of(end), [4, 1])
    assert len(tape.time) == 0


def test_a_row_stops_before_it_acts_and_for_good():
    asked = jnp.asarray([1, 1, 0])

    def stop(time, percept):
        assert percept.encoded.rest.shape == (3, 2)
        return time == asked  # later it would be free to go again

    end, tape = taped(STILL, 2, 3, 4, stop=stop)
    np.testing.assert_array_equal(cells_of(end), [3, 4, 4])
    np.testing.assert_array_equal(end.time, [1, 1, 0])
    # Alive, and not moved, at the step at which it stops.
    np.testing.assert_array_equal(tape.alive.T, [[1, 1], [1, 1], [1, 0]])
    np.testing.assert_array_equal(tape.moved.T, [[1, 0], [1, 0], [0, 0]])


def test_a_row_stops_by_what_is_seen():
    end, tape = taped(STILL, 2, 1, 5, stop=lambda _, percept: percept.encoded.rest[:, 0] == 5)
    np.testing.assert_array_equal(cells_of(end), [5, 0, 5])
    np.testing.assert_array_equal(tape.moved.T, [[1, 1, 1, 0], [1, 0, 0, 0], [0, 0, 0, 0]])


def test_what_ends_an_episode_can_be_told():
    end, tape = taped(SHORT, 4, 1, over=lambda outcome: outcome.truncated)
    # Through the pit and on; and from the coin back to the left of it and so on.
    np.testing.assert_array_equal(cells_of(tape.states).T, [[4, 5, 6, 7], [1, 0, 1, 0]])
    np.testing.assert_array_equal(tape.outcome.danger[:, 0], [0, 1, 0, 0])
    assert tape.moved.all()
    np.testing.assert_array_equal(cells_of(end), [8, 1])
    np.testing.assert_array_equal(end.time, [4, 4])


@pytest.mark.parametrize(("steps", "ends"), [(0, [4, 1, 3]), (2, [6, 0, 5]), (5, [6, 0, 6])])
def test_as_many_steps_are_made_as_asked_for_whether_or_not_episodes_have_ended(steps, ends):
    end, tape = taped(STILL, 4, 1, 3, steps=steps)
    np.testing.assert_array_equal(tape.time, np.arange(steps))
    np.testing.assert_array_equal(cells_of(end), ends)
    alive = [[1, 1, 0, 0, 0], [1, 0, 0, 0, 0], [1, 1, 1, 0, 0]]
    np.testing.assert_array_equal(tape.alive.T, np.asarray(alive)[:, :steps])
    if steps == 5:  # after an end, the terminal state again
        np.testing.assert_array_equal(cells_of(tape.states)[:, 0], [4, 5, 6, 6, 6])


class View(NamedTuple):
    """What is seen of a counter."""

    number: jax.Array
    looked: jax.Array  # bool, `perceive` was told that it must be right here


class Count:
    """A world of numbers that go up by their action and end at 10; no P-MDP at all."""

    def perceive(self, states, alive=None):
        assert alive is not None
        return View(states["number"], alive)

    def advance(self, keys, states, actions, percept):
        number = states["number"] + actions
        no = jnp.zeros(number.shape, bool)
        outcome = Outcome(number.astype(float), jnp.zeros(number.shape), number >= 10, no, no)
        return {"number": number}, outcome


def test_any_world_will_do_and_a_terminal_state_is_looked_at_once_only():
    def fold(carry, step):
        return jnp.concatenate([carry[1:], step.percept.looked[None]])

    def policy(_, view):
        return jnp.full(view.number.shape, 5), jnp.zeros(view.number.shape, bool)

    states = {"number": jnp.asarray([0, 5, 7, 0])}
    alive = jnp.asarray([True, True, True, False])
    looked = jnp.zeros((4, 4), bool)
    end, looked = rollout(
        jax.random.key(0), Count(), policy, states, fold, looked, alive=alive, steps=4
    )
    np.testing.assert_array_equal(end["number"], [10, 10, 12, 0])
    # The first acts twice, the two next once, and each is looked at once more.
    np.testing.assert_array_equal(looked.T, [[1, 1, 1, 0], [1, 1, 0, 0], [1, 1, 0, 0], [0] * 4])


SLIPPERY = STILL.replace(params=probe.make_params(slip=0.5))


def test_policy_and_world_are_given_a_new_key_at_every_step():
    """Against the same, one step and one row after another."""
    end, tape = taped(SLIPPERY, 2, 3, 4, policy=recording.explore, key=7)
    act_key, step_key = jax.random.split(jax.random.key(7))
    row_keys = jax.random.split(step_key, 3)
    states, alive = [jax.tree.map(lambda a, i=i: a[i], at(2, 3, 4)) for i in range(3)], [True] * 3
    for time in range(len(tape.time)):
        np.testing.assert_array_equal(tape.alive[time], alive)
        pick = jax.random.split(jax.random.fold_in(act_key, time), 3)
        for i in np.flatnonzero(alive):
            action = shield.masked_sample(pick[i], jnp.ones(3, bool))
            assert tape.action[time, i] == action
            now = jax.random.fold_in(row_keys[i], time)
            states[i], outcome = probe.step(now, states[i], action, SLIPPERY.params)
            alive[i] = not outcome.done
            assert cells_of(tape.reached)[time, i] == cells_of(states[i])
    assert not any(alive)
    np.testing.assert_array_equal(cells_of(end), [cells_of(state) for state in states])


def test_no_row_depends_on_another():
    two = [taped(SLIPPERY, *cells, key=3) for cells in ([2, 3, 4], [2, 5, 1])]
    (end, tape), (other_end, other) = two
    steps = min(len(tape.time), len(other.time))
    assert steps > 2
    np.testing.assert_array_equal(
        cells_of(tape.reached)[:steps, 0], cells_of(other.reached)[:steps, 0]
    )
    assert cells_of(end)[0] == cells_of(other_end)[0]
    asleep = jnp.asarray([True, False, False])
    alone, _ = taped(SLIPPERY, 2, 3, 4, key=3, alive=asleep)
    assert (cells_of(alone)[0], alone.time[0]) == (cells_of(end)[0], end.time[0])
