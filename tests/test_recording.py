import functools

import jax
import jax.numpy as jnp
import numpy as np
import probe
from quick import compile_soon  # noqa: F401
from shields import PROBE, at, eager, narrow

from rp_jax import recording
from rp_jax.envs import circuit


@functools.cache
def recorded():
    still = at(np.inf)().replace(params=probe.make_params(slip=0.0))
    starts = jax.vmap(probe.start_at)(jnp.asarray([4.0, 1.0, 3.0]))

    def values(percept):
        left = jnp.asarray([[0.0, 1.0, 0.0]])
        return jnp.where(percept.encoded.rest[:, :1] == 1.0, left, eager(percept))

    record = jax.jit(recording.record, static_argnums=(2, 4))
    return record(jax.random.key(0), still, values, starts, 5)


def test_a_recording_shows_every_step_and_then_the_end():
    shown = recorded()
    cells = np.asarray(shown.states.body.position[..., 0]).T
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
    beside = np.asarray(shown.states.body.position[..., 0]) == 5
    np.testing.assert_allclose(shown.threat[beside], [[0, 0, 1]] * 2, atol=1e-6)
    assert shown.admissible.all()
    assert shown.secure.all()


visit = jax.jit(recording.visited_states, static_argnums=(2, 3))


def test_visited_states_are_many_and_under_way():
    states = visit(jax.random.key(0), PROBE, 400, 10)
    cells, times = np.asarray(states.body.position[:, 0]), np.asarray(states.time)
    assert cells.shape == times.shape == (400,)
    assert set(np.unique(cells)) == {1, 2, 3, 4, 5}  # none has ended
    assert set(np.unique(times)) == set(range(10))
    other = visit(jax.random.key(1), PROBE, 400, 10)
    assert not np.array_equal(cells, other.body.position[:, 0])


def test_visited_states_are_reached_by_admissible_actions_only():
    states = visit(jax.random.key(2), at(-1.0)(), 400, 10)
    # Where nothing is admissible, the least threatening of equals is the first: to stay.
    assert set(np.unique(states.body.position[:, 0])) == set(probe.STARTS)


def test_visited_states_of_circuit_lie_on_the_track():
    pmdp = narrow()
    states = visit(jax.random.key(3), pmdp, 30, 20)
    crashed = jax.jit(jax.vmap(circuit.collisions, (0, None)))(states, pmdp.params)["wall"]
    assert not crashed.any()
    assert len(np.unique(states.body.position[:, 0])) == 30
    assert states.time.max() > 10
