"""What holds of every environment: add yours to ENVS."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401

from examples.crossing import world as crossing
from examples.drone import world as drone
from examples.trolley import world as trolley
from rp_jax.envs import autoreset, circuit, contract, jam, optional, patrol, point_gather
from rp_jax.envs.check.purity import shared_memory
from rp_jax.hazards import SubRMDP
from rp_jax.planning.budgeted import Budgeted
from rp_jax.planning.conditioned import Conditioned
from rp_jax.planning.wrapped import ranged

ENVS = {
    "circuit": (circuit, lambda: circuit.make_params()),
    "circuit-paper": (circuit, lambda: circuit.make_params("circle", fidelity="paper")),
    "jam-3-plans": (jam, lambda: jam.make_params(3, baseline="plans")),
    "jam-8": (jam, lambda: jam.make_params(8)),
    "circuit-plans": (circuit, lambda: circuit.make_params(baseline="plans")),
    "jam-3-paper": (jam, lambda: jam.make_params(3, fidelity="paper")),
    "point_gather": (point_gather, lambda: point_gather.make_params(2, 8)),
    "point_gather-1-paper": (
        point_gather,
        lambda: point_gather.make_params(0, 1, fidelity="paper"),
    ),
    "patrol": (patrol, lambda: patrol.make_params(3)),
    "crossing": (crossing, lambda: crossing.make_params()),
    "trolley": (trolley, lambda: trolley.make_params(20)),
}
GOES_ON = ("point_gather",)  # after a hit: what is hit is gone
LIMIT, STEPS, ROWS = 25, 300, 7
FUNCTIONS = ["reset", "step", "observe", "hazards", "sub_rmdps"]  # others are optional
# One of each module, for tests that are long and to which the variant does not matter.
EACH_MODULE = {env: name for name, (env, _) in reversed(ENVS.items())}
every_env = pytest.mark.parametrize(  # a simulated body takes long to compile
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "trolley")) for name in ENVS]
)
every_module = pytest.mark.parametrize("name", EACH_MODULE.values())


@functools.lru_cache
def made(name):
    env, make = ENVS[name]
    return env, make().replace(time_limit=jnp.asarray(LIMIT, jnp.int32))


def play(env, row_keys, params):
    """Every row plays at random; returns what each step had and led to, axes (steps, rows)."""
    actions = optional.num_actions(env, params)
    hit = functools.partial(optional.collisions, env)

    def step(states, t):
        keys = jax.vmap(jax.random.fold_in, (0, None))(row_keys, t)
        pick = lambda key: jax.random.randint(jax.random.fold_in(key, 1), (), 0, actions)  # noqa: E731
        action = jax.vmap(pick)(keys)
        carried, reached, outcome = autoreset.auto_reset_step(env, keys, states, action, params)
        look = lambda f: jax.vmap(f, (0, None))(reached, params)  # noqa: E731
        seen = {"observe": look(env.observe), "hazards": look(env.hazards), "collisions": look(hit)}
        data = jax.random.key_data(keys)  # typed keys are no arrays to numpy
        seen |= {"keys": data, "before": states, "action": action}
        return carried, seen | {"reached": reached, "outcome": outcome, "carried": carried}

    # They begin at the limit, so that the first thing to happen is a fresh start.
    shapes = jax.eval_shape(env.reset, row_keys[0], params)
    blank = jax.tree.map(lambda a: jnp.zeros((len(row_keys), *a.shape), a.dtype), shapes)
    blank = blank.replace(time=blank.time + LIMIT - 1)
    return jax.lax.scan(step, blank, jnp.arange(STEPS))[1]


jitted_play = jax.jit(play, static_argnums=0)


APART = {
    "drone": (drone, lambda: drone.make_params()),
    "conditioned": (Conditioned(crossing), lambda: ranged(crossing.make_params(), 0.1, 0.1)),
    "budgeted": (Budgeted(crossing), lambda: ranged(crossing.make_params(), 0.1, 0.1)),
}


@pytest.mark.parametrize("name", [*ENVS, *APART])
def test_a_state_has_memory_of_its_own_which_may_be_given_away(name):
    """Also if `reset` was not compiled; `donate_argnums` would delete what is shared."""
    env, make = (ENVS | APART)[name]
    params = make()
    state = env.reset(jax.random.key(0), params)
    other = env.reset(jax.random.key(0), params)
    assert shared_memory("reset", state, params, other) == []
    if name == "budgeted":
        jax.jit(env.step, donate_argnums=1)(jax.random.key(1), state, jnp.asarray(0), params)
        assert not any(leaf.is_deleted() for leaf in jax.tree.leaves(params))


def keys_of(seed):
    return jax.random.split(jax.random.key(seed), ROWS)


@functools.lru_cache
def played(name):
    return replay(name, keys_of(0))


def replay(name, row_keys):
    env, params = made(name)
    return jax.device_get(jitted_play(env, row_keys, params))


@functools.lru_cache
def stepper(name):
    """A jitted step of a batch, and a list that grows whenever it is traced.

    It takes a time limit for every row, which sweeps this parameter.
    """
    (env, params), traced = made(name), []
    axes = jax.tree.map(lambda _: None, params).replace(time_limit=0)

    @jax.jit
    def run(keys, states, actions, params, limits):
        traced.append(name)
        swept = params.replace(time_limit=limits)
        return jax.vmap(env.step, (0, 0, 0, axes))(keys, states, actions, swept)

    def step(keys, states, actions, params=params, limits=LIMIT):
        limits = np.broadcast_to(np.int32(limits), ROWS)
        return jax.device_get(run(keys, states, actions, params, limits))

    return step, traced


def same_bits(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def row(tree, *index):
    return jax.tree.map(lambda a: a[index], tree)


def described(tree):
    return jax.tree.structure(tree), [(a.shape, a.dtype) for a in jax.tree.leaves(tree)]


@every_env
def test_an_environment_has_every_function_of_the_contract(name):
    env, params = made(name)
    assert all(callable(getattr(env, function)) for function in FUNCTIONS)
    actions = optional.num_actions(env, params)
    assert isinstance(actions, int)
    assert actions > 1
    subs = env.sub_rmdps(params)
    assert all(isinstance(sub, SubRMDP) for sub in subs.values())
    state = jax.eval_shape(env.reset, jax.random.key(0), params)
    assert set(jax.eval_shape(env.hazards, state, params)) == set(subs)
    hit = functools.partial(optional.collisions, env)
    assert set(jax.eval_shape(hit, state, params)) >= set(subs)  # walls may be joint


@every_env
def test_a_step_keeps_structure_shapes_and_types_of_the_state(name):
    env, params = made(name)
    key, action = jax.random.key(0), jnp.asarray(0)
    state = jax.eval_shape(env.reset, key, params)
    reached, outcome = jax.eval_shape(env.step, key, state, action, params)
    assert described(reached) == described(state)
    assert state.time.shape == ()
    assert state.time.dtype == jnp.int32
    assert {a.shape for a in jax.tree.leaves(outcome)} == {()}
    assert outcome.reward.dtype == outcome.danger.dtype == jnp.float32
    for field in (outcome.terminated, outcome.truncated, outcome.goal):
        assert field.dtype == bool
    again = jax.eval_shape(env.step, key, reached, action, params)[0]
    assert described(again) == described(state)


@every_module
def test_everything_is_double_when_double_precision_is_on(name, x64):
    env, make = ENVS[name]
    params = make()
    state = jax.eval_shape(env.reset, jax.random.key(0), params)
    reached, outcome = jax.eval_shape(env.step, jax.random.key(0), state, jnp.asarray(0), params)
    floats = [a for a in jax.tree.leaves((reached, outcome)) if jnp.issubdtype(a.dtype, float)]
    assert floats
    assert {a.dtype for a in floats} == {jnp.dtype("float64")}
    assert jax.eval_shape(env.observe, state, params).dtype == jnp.float64


@every_env
def test_observations_have_the_length_that_learners_are_told(name):
    (env, params), seen = made(name), played(name)["observe"]
    size, bins = optional.observation_size(env, params), optional.lidar_bins(env)
    scale = optional.scale(env) or (1.0,) * (size - bins)
    assert seen.shape == (STEPS, ROWS, size)
    assert size == bins + len(scale)
    assert seen.dtype == jnp.float32
    assert (seen[..., :bins] >= 0).all()


@every_env
def test_all_values_stay_finite_over_whole_episodes(name):
    rows = played(name)
    for part in ("reached", "carried", "outcome", "observe"):
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(rows[part]))


@every_env
def test_episodes_end_in_either_way_but_never_both(name):
    outcome = played(name)["outcome"]
    assert outcome.terminated.any() or name in GOES_ON
    assert outcome.truncated.any()
    assert not (outcome.terminated & outcome.truncated).any()
    np.testing.assert_array_equal(outcome.done, outcome.terminated | outcome.truncated)


@every_env
def test_the_time_limit_truncates_exactly_at_its_step(name):
    rows = played(name)
    outcome, time = rows["outcome"], rows["reached"].time
    np.testing.assert_array_equal(time, rows["before"].time + 1)
    np.testing.assert_array_equal(outcome.truncated, (time == LIMIT) & ~outcome.terminated)
    assert time.max() == LIMIT


@every_env
def test_danger_is_exactly_where_some_hazard_is_hit(name):
    rows = played(name)
    outcome = rows["outcome"]
    hit = functools.reduce(np.logical_or, rows["collisions"].values())
    assert hit.any()
    np.testing.assert_array_equal(outcome.danger > 0, hit)
    assert ((outcome.terminated & (outcome.danger == 1)) | ~hit | (name in GOES_ON)).all()
    assert not (outcome.goal & hit).any()
    assert (outcome.terminated | ~outcome.goal).all()


@every_module
def test_collisions_are_with_hazards_that_are_present_and_hit(name):
    env, params = made(name)
    rows = played(name)
    for kind, sub in env.sub_rmdps(params).items():
        states, present = rows["hazards"][kind]
        assert present.dtype == bool
        over_hazards = jax.vmap(sub.source.hits, (None, 0))
        if env is point_gather:  # what was there before the step and is hit is gone after it
            look = jax.vmap(jax.vmap(env.hazards, (0, None)), (0, None))
            states, present = jax.jit(look)(rows["before"], params)[kind]
        hits = jax.jit(jax.vmap(jax.vmap(over_hazards)))(rows["reached"].body, states)
        np.testing.assert_array_equal(rows["collisions"][kind], (hits & present).any(axis=-1))


@every_env
def test_equal_keys_play_equal_episodes_and_others_do_not(name):
    rows = played(name)
    same_bits(replay(name, keys_of(0)), rows)
    other = replay(name, keys_of(1))
    assert (other["observe"] != rows["observe"]).any()


@every_module
def test_no_row_of_a_batch_depends_on_the_others(name):
    some = np.asarray([5, 0, 6])
    fewer = replay(name, keys_of(0)[some])
    same_bits(fewer, jax.tree.map(lambda a: a[:, some], played(name)))


@every_env
def test_a_step_can_start_from_any_state_and_has_no_memory(name):
    env, params = made(name)
    rows, (step, _) = played(name), stepper(name)
    # States of 7 rows at 7 times, and their bodies exchanged: situations nobody was in.
    mixed = row(rows["before"], np.arange(3, 10) * 20, np.arange(7))
    bodies = row(rows["before"].body, np.arange(9, 2, -1) * 25, np.arange(7))
    times = np.asarray([0, 3, LIMIT - 2, LIMIT - 1, LIMIT, 99, 0], np.int32)
    mixed = mixed.replace(body=bodies, time=times)
    action = np.arange(7, dtype=np.int32) % optional.num_actions(env, params)
    reached, outcome = step(keys_of(2), mixed, action)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((reached, outcome)))
    np.testing.assert_array_equal(reached.time, mixed.time + 1)
    np.testing.assert_array_equal(outcome.done[3:6], [True] * 3)
    # Whatever happened in between, the same state is left in the same way.
    step(keys_of(3), row(rows["before"], 0), action)
    same_bits(step(keys_of(2), mixed, action), (reached, outcome))


@every_env
def test_after_an_end_a_fresh_start_is_carried_and_otherwise_the_state_reached(name):
    rows = played(name)
    done, time = rows["outcome"].done, rows["carried"].time
    assert (time[done] == 0).all()
    assert (time[~done] > 0).all()
    same_bits(row(rows["carried"], ~done), row(rows["reached"], ~done))
    leaves = jax.tree.leaves(row(rows["carried"], done))
    starts = np.concatenate([leaf.reshape(done.sum(), -1) for leaf in leaves], axis=1)
    assert len(starts) > 20
    assert len(np.unique(starts, axis=0)) > 0.9 * len(starts)  # drawn anew, not replayed
    same_bits(row(rows["before"], slice(1, None)), row(rows["carried"], slice(None, -1)))


@every_env
def test_the_state_reached_is_that_of_the_step_even_where_it_is_terminal(name):
    rows, (step, _) = played(name), stepper(name)
    terminated = rows["outcome"].done if name in GOES_ON else rows["outcome"].terminated
    t = int(np.argmax(terminated.sum(axis=1)))
    assert terminated[t].any()
    at = {part: row(rows[part], t) for part in ("keys", "before", "action", "reached", "outcome")}
    keys = jax.vmap(jax.random.split)(jax.random.wrap_key_data(at["keys"]))[:, 0]
    expected = step(keys, at["before"], at["action"])
    close = functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5)
    jax.tree.map(close, (at["reached"], at["outcome"]), expected)
    assert (at["reached"].time[terminated[t]] > 0).all()


@every_env
def test_a_parameter_can_be_swept_by_vmap_and_others_changed_without_compiling_again(name):
    before, (step, traced) = row(played(name)["before"], 10), stepper(name)
    args = keys_of(4), before, np.zeros(ROWS, np.int32)
    limits = np.asarray([1, 10, 11, 12, LIMIT, LIMIT + 1, 1000], np.int32)
    reached, outcome = step(*args, limits=limits)
    np.testing.assert_array_equal(outcome.truncated, (reached.time >= limits) & ~outcome.terminated)
    assert outcome.truncated.any()
    assert not outcome.truncated.all()
    params = made(name)[1]
    step(*args, params.replace(beta=jnp.float32(0.5)), limits[::-1])
    assert len(traced) == 1


def test_the_time_limit_never_hides_a_true_end():
    terminated, truncated = contract.ended(
        jnp.asarray([True, False, True, False]), jnp.asarray([5, 5, 4, 4]), jnp.asarray(5)
    )
    np.testing.assert_array_equal(terminated, [True, False, True, False])
    np.testing.assert_array_equal(truncated, [False, True, False, False])
