import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from quick import compile_soon  # noqa: F401

from rp_jax import evaluation
from rp_jax.envs import circuit, jam, optional, point_gather
from rp_jax.planning import loop
from rp_jax.planning.loop import LoopConfig
from rp_jax.recon.labels import exact_threat


class Bare:
    """The corridor with the five functions that every environment must have, and no more."""

    reset = staticmethod(probe.reset)
    step = staticmethod(probe.step)
    observe = staticmethod(probe.observe)
    hazards = staticmethod(probe.hazards)
    sub_rmdps = staticmethod(probe.sub_rmdps)


class Own(Bare):
    """Says all itself, and other things than would hold by default."""

    LIDAR_BINS = 16
    SCALE = (0.2, 0.1)

    @staticmethod
    def num_actions(params):
        return 2

    @staticmethod
    def collisions(state, params):
        return {"ghost": state.time > 3}

    @staticmethod
    def clearance(position, params):
        return 6.0 - position[0]


PARAMS = probe.make_params()
TIME_4 = probe.start_at(2).replace(time=jnp.asarray(4))


def test_there_are_as_many_actions_as_rows_in_the_table_of_controls():
    assert optional.num_actions(Bare, PARAMS) == 3
    wider = PARAMS.replace(
        body=PARAMS.body.replace(actions=probe.moves([0.0, -1.0, 1.0, 2.0, 3.0]))
    )
    assert optional.num_actions(Bare, wider) == 5
    assert optional.num_actions(Own, PARAMS) == 2


@pytest.mark.parametrize(
    ("cell", "hit"),
    # The pit at 6 has a radius of .5; the hazard at 0 is not present.
    [(0.0, False), (5.0, False), (5.4, False), (5.6, True), (6.0, True), (7.0, False)],
)
def test_what_is_hit_are_hazards_that_are_present_and_that_their_source_says_are_hit(cell, hit):
    found = jax.jit(optional.collisions, static_argnums=0)(Bare, probe.start_at(cell), PARAMS)
    assert found == {"pit": hit}
    assert found["pit"].shape == ()
    assert found["pit"].dtype == bool


def test_an_environment_s_own_word_on_what_is_hit_goes_before():
    assert optional.collisions(Own, TIME_4, PARAMS) == {"ghost": True}
    assert optional.collisions(Own, probe.start_at(6), PARAMS) == {"ghost": False}


@pytest.mark.parametrize("env", [jam, point_gather])
def test_the_built_in_environments_say_what_would_hold_by_default(env):
    """Of the wall, only points in reach are hazards, but what is hit is in reach."""
    params = env.make_params()

    class Silent:
        hazards, sub_rmdps = staticmethod(env.hazards), staticmethod(env.sub_rmdps)

    assert optional.num_actions(Silent, params) == env.num_actions(params)
    if env is point_gather:  # there, what is hit is gone, and not a hazard any more
        return
    states = jax.vmap(env.reset, (0, None))(jax.random.split(jax.random.key(0), 200), params)
    place = 3 * jax.random.uniform(jax.random.key(1), (200, 2))
    states = states.replace(body=states.body.replace(position=place))

    @jax.jit
    @jax.vmap
    def both(state):
        return optional.collisions(Silent, state, params), env.collisions(state, params)

    default, own = both(states)
    jax.tree.map(np.testing.assert_array_equal, default, own)
    assert all(0 < hit.mean() < 1 for hit in own.values())


def test_nothing_is_fixed_unless_an_environment_says_so(precision):
    position = jnp.asarray([2.0, 0.0])
    free = optional.clearance(Bare, position, PARAMS)
    assert free == jnp.inf
    assert free.shape == ()
    assert free.dtype == position.dtype == precision
    assert optional.clearance(Own, position, PARAMS) == 4.0


def test_an_observation_is_no_lidar_and_not_scaled_unless_an_environment_says_so():
    assert optional.lidar_bins(Bare) == 0
    assert optional.scale(Bare) == ()
    assert optional.lidar_bins(Own) == optional.lidar_bins(probe) == 16
    assert optional.scale(Own) == optional.scale(probe) == (0.2, 0.1)


@pytest.mark.parametrize(("env", "size"), [(circuit, 364), (jam, 396), (point_gather, 29)])
def test_the_length_of_an_observation_is_known_without_one(env, size):
    assert optional.observation_size(env, env.make_params()) == size


def test_a_bare_environment_is_observed_as_it_is():
    pmdp = probe.make_pmdp(Bare, PARAMS)
    states = jax.vmap(probe.start_at)(jnp.asarray([1.0, 5.0]))
    percept = jax.jit(pmdp.perceive)(states)
    assert pmdp.num_actions == 3
    assert percept.encoded.scan.shape == (2, 0)
    np.testing.assert_array_equal(
        percept.encoded.rest, jax.vmap(probe.observe, (0, None))(states, PARAMS)
    )
    np.testing.assert_array_equal(percept.admissible, [[True] * 3, [True, True, False]])


def test_a_bare_environment_is_labelled_learned_and_evaluated():
    sub = Bare.sub_rmdps(PARAMS)["pit"]
    beside = probe.start_at(5).body
    label = exact_threat(jax.random.key(0), beside, jnp.asarray([probe.PIT, 0.0]), sub)
    np.testing.assert_allclose(label.threat, [0, 0, 0.999], atol=1e-6)
    config = LoopConfig(steps=64, num_envs=8, batch=8, replay=64, replay_start=8)
    pmdp = probe.make_pmdp(Bare, PARAMS)
    with jax.numpy_rank_promotion("allow"):  # flashbax needs it
        state, metrics = jax.jit(loop.init, static_argnums=2)(jax.random.key(1), pmdp, config)
    assert (metrics.bad_observations, metrics.inadmissible) == (0, 0)
    values = evaluation.action_values(loop.make_network(config, pmdp), state.learner.params)

    @jax.jit
    def episodes(pmdp):
        return evaluation.run_episodes(jax.random.key(2), pmdp, values, 6)

    rows = episodes(pmdp)
    assert set(rows.collisions) == {"pit"}
    assert not rows.collisions["pit"].any()
    free = episodes(pmdp.replace(x=jnp.asarray(jnp.inf)))
    np.testing.assert_array_equal(free.collisions["pit"], free.danger == 1)
