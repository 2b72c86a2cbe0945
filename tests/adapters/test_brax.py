import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401

from rp_jax.adapters import brax, registry
from rp_jax.envs import optional

SETTINGS = {"jam": {"num_obstacles": 3}}
ROWS = 5
every_env = pytest.mark.parametrize("name", registry.ENVS)
ACTIONS = [jnp.asarray(3), jnp.asarray([0.7, -0.2])]


def raw(seed):
    return jax.random.key_data(jax.random.key(seed))


def raws(seed, count=ROWS):
    return jax.random.key_data(jax.random.split(jax.random.key(seed), count))


@functools.cache
def made(name, time_limit=100):
    return brax.envs.get_environment(
        f"rp_jax_{name}", time_limit=time_limit, **SETTINGS.get(name, {})
    )


def same_bits(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def described(tree):
    return jax.tree.structure(tree), [(a.shape, a.dtype) for a in jax.tree.leaves(tree)]


@every_env
@pytest.mark.parametrize("action", ACTIONS, ids=["discrete", "continuous"])
def test_transitions_are_those_of_the_environment_bit_for_bit(name, action):
    env = made(name)
    task, params = env.env, env.params
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    plain = jax.jit(task.step)
    state = reset(raw(0))
    first = jax.random.split(jax.random.key(0))[0]
    same_bits(state.pipeline_state, jax.jit(task.reset)(first, params))
    for _ in range(12):
        key = jax.random.split(jax.random.wrap_key_data(state.info["key"]))[0]
        reached, outcome = plain(key, state.pipeline_state, action, params)
        state = step(state, action)
        same_bits(state.pipeline_state, reached)
        same_bits(state.obs, jax.jit(task.observe)(reached, params))
        assert state.reward == outcome.reward
        assert state.done == outcome.terminated
        assert state.info["cost"] == state.metrics["cost"] == outcome.danger
        assert state.info["truncation"] == outcome.truncated


@every_env
def test_a_typed_key_starts_as_its_raw_one_does(name):
    same_bits(*(jax.jit(made(name).reset)(key) for key in (raw(1), jax.random.key(1))))


@every_env
@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("double", [False, True])
def test_a_state_keeps_its_structure_and_its_types_those_of_the_precision(name, wrapped, double):
    with jax.enable_x64(double):
        env, key, action = made.__wrapped__(name), raw(0), jnp.zeros(2)
        table = jnp.zeros((optional.num_actions(env.env, env.params), 2))
        env = brax.ShieldWrapper(env, lambda state: jnp.zeros(len(table)), 0.1, table)
        if wrapped:
            env, key, action = brax.wrap(env, 50), raws(0), jnp.zeros((ROWS, 2))
        state = jax.eval_shape(env.reset, key)
        reached = jax.eval_shape(env.step, state, action)
        assert state.obs.shape[-1] == env.observation_size
    assert described(reached) == described(state)
    told = state.obs, state.reward, state.done, state.metrics, state.info["truncation"]
    assert {a.dtype for a in jax.tree.leaves(told)} == {jnp.dtype(f"float{64 if double else 32}")}
    assert env.action_size == 2
    assert {"cost", "truncation"} <= set(state.info)
    assert "cost" in state.metrics


@functools.cache
def rolled(name):
    """What 120 steps of full speed ahead lead to, in episodes of at most 30."""
    env = brax.wrap(made(name), 30)
    begin = jax.jit(env.reset)(raws(7))

    def step(state, _):
        reached = env.step(state, jnp.tile(jnp.asarray([[1.0, 0.1]]), (ROWS, 1)))
        return reached, reached

    return jax.device_get((begin, jax.jit(lambda s: jax.lax.scan(step, s, length=120)[1])(begin)))


@every_env
def test_every_start_is_drawn_anew(name):
    _, states = rolled(name)
    done = states.done > 0
    assert done.sum() > 2 * ROWS
    after = jax.tree.map(lambda a: a[done].reshape(done.sum(), -1), states.pipeline_state)
    assert (after.time == 0).all()
    starts = np.concatenate(jax.tree.leaves(after), axis=1)
    assert len(np.unique(starts, axis=0)) == len(starts)


@every_env
def test_the_observation_is_of_the_new_start_and_the_last_one_is_kept(name):
    env, (_, states) = made(name), rolled(name)
    look = jax.jit(jax.vmap(jax.vmap(env.env.observe, (0, None)), (0, None)))
    close = functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5)
    close(look(states.pipeline_state, env.params), states.obs)
    done = states.done > 0
    np.testing.assert_array_equal(states.obs[~done], states.info["final_obs"][~done])
    assert (states.obs[done] != states.info["final_obs"][done]).any(axis=-1).all()


@every_env
def test_costs_are_counted_and_a_time_limit_is_no_end(name):
    _, states = rolled(name)
    done, cut = states.done > 0, states.info["truncation"] > 0
    cost = states.info["cost"]
    np.testing.assert_array_equal(cost, states.metrics["cost"])
    if name != "point_gather":  # where a bomb does not end the episode
        assert (done[cost > 0] & ~cut[cost > 0]).all()
    assert (done | ~cut).all()
    assert cost.sum() > 0
    np.testing.assert_array_equal(states.info["steps"][cut], 30)


def test_the_shorter_of_both_time_limits_counts_and_is_a_truncation():
    env = brax.wrap(made("circuit", 4), 50)
    state, step = jax.jit(env.reset)(raws(0)), jax.jit(env.step)
    for t in range(1, 10):  # at a standstill nothing is hit
        state = step(state, jnp.zeros((ROWS, 2)))
        np.testing.assert_array_equal(state.info["truncation"], float(t % 4 == 0))
        np.testing.assert_array_equal(state.done, float(t % 4 == 0))
        np.testing.assert_array_equal(state.pipeline_state.time, t % 4)


class Counter(brax.Env):
    """Anyone's environment: remembers its action, and ends when it has counted to a random number.

    It has 4 discrete actions; with `floats`, continuous ones of 2 numbers.
    """

    observation_size, action_size, backend = 1, 2, "none"

    def __init__(self, floats=False):
        self.blank = jnp.zeros(2) if floats else jnp.asarray(0)

    def reset(self, rng):
        last = jax.random.randint(jax.random.wrap_key_data(rng), (), 1, 1000)
        state = {"left": last % 4 + 1, "start": last, "action": self.blank}
        no = jnp.zeros(())
        return brax.State(state, last[None] * 1.0, no, no, {}, {})

    def step(self, state, action):
        now = state.pipeline_state
        left = now["left"] - 1
        after = {"left": left, "start": now["start"], "action": action}
        return state.replace(pipeline_state=after, done=(left == 0).astype(jnp.float32))


def test_anyones_environment_gets_fresh_starts():
    env = brax.wrap(Counter(), 100)
    state, step = jax.jit(env.reset)(raws(0, 40)), jax.jit(env.step)
    seen = [state.pipeline_state["start"]]
    for _ in range(8):
        state = step(state, jnp.zeros(40, int))
        seen.append(state.pipeline_state["start"])
    per_row = [len(set(column)) for column in np.asarray(seen).T.tolist()]
    assert min(per_row) > 2  # by brax's own wrapper it would be 1


def threat_of(state):
    """Two of four actions are too dangerous, which ones depends on the state."""
    even = state.pipeline_state["left"] % 2 == 0
    pattern = jnp.asarray([[0.0, 0.5, 0.9, 0.05], [0.5, 0.0, 0.125, 0.8]])
    return pattern[even.astype(jnp.int32)]


@pytest.mark.parametrize("batched", [False, True])
def test_no_inadmissible_action_passes_and_substitutes_are_counted(batched):
    env = brax.training.VmapWrapper(Counter()) if batched else Counter()
    env = brax.ShieldWrapper(env, threat_of, 0.125)
    step = jax.jit(env.step)
    state = env.reset(raws(0) if batched else raw(0))
    assert (state.info["intervention"] == 0).all()
    for wish in (0, 1, 2, 3, 2):
        threat = np.asarray(threat_of(state)).reshape(-1, 4)
        action = jnp.full(ROWS, wish) if batched else jnp.asarray(wish)
        state = step(state, action)
        expected = np.where(threat[:, wish] <= 0.125, wish, threat.argmin(axis=1))
        np.testing.assert_array_equal(np.ravel(state.pipeline_state["action"]), expected)
        np.testing.assert_array_equal(np.ravel(state.info["intervention"]), expected != wish)
        same_bits(state.info, state.metrics)
        assert (state.info["insecure"] == 0).all()


def test_scores_and_continuous_actions_give_way_to_the_next_best():
    scored = brax.ShieldWrapper(Counter(), lambda state: jnp.asarray([0.9, 0.0, 0.0, 0.9]), 0.1)
    state = scored.step(scored.reset(raw(0)), jnp.asarray([9.0, 1.0, 2.0, 3.0]))
    assert state.pipeline_state["action"] == 2
    table = jnp.asarray([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    nearest = brax.ShieldWrapper(Counter(True), scored.threat, 0.1, table)
    for wish, row, replaced in (([0.2, 0.1], 1, 1), ([0.1, 0.9], 2, 0), ([1.0, 1.5], 2, 1)):
        state = nearest.step(nearest.reset(raw(0)), jnp.asarray(wish))
        np.testing.assert_array_equal(state.pipeline_state["action"], table[row])
        assert state.info["intervention"] == replaced


def test_where_nothing_is_admissible_the_least_threatening_action_is_taken():
    env = brax.ShieldWrapper(Counter(), lambda state: jnp.asarray([0.9, 0.7, 0.3, 0.8]), 0.1)
    state = env.step(env.reset(raw(0)), jnp.asarray(0))
    assert state.pipeline_state["action"] == 2
    assert state.info["insecure"] == state.metrics["insecure"] == 1
    free = brax.ShieldWrapper(Counter(), env.threat, jnp.inf)
    state = free.step(free.reset(raw(0)), jnp.asarray(0))
    assert state.pipeline_state["action"] == state.info["intervention"] == 0


def test_a_threat_just_above_the_threshold_is_not_rounded_into_it():
    above = np.float32(0.001)  # .0010000000475
    env = brax.ShieldWrapper(Counter(), lambda state: jnp.asarray([above, 0.0, 0.0, 0.0]), 0.001)
    state = jax.jit(env.step)(env.reset(raw(0)), jnp.asarray(0))
    assert state.info["intervention"] == 1


def test_threats_in_double_precision_are_not_rounded_down_to_the_threshold():
    x = float(np.float32(0.01))
    above = np.asarray([[0.01, 0.0, 0.0, 0.0]])  # by 2e-10; the nearest float32 is x
    assert above[0, 0] > x
    for lead in (True, False):
        env = brax.training.VmapWrapper(Counter()) if lead else Counter()
        env = brax.ShieldWrapper(env, lambda state, lead=lead: above if lead else above[0], x)
        state = env.reset(raws(0, 1) if lead else raw(0))
        state = jax.jit(env.step)(state, jnp.zeros((1,) * lead, jnp.int32))
        assert (state.info["intervention"] == 1).all()


def test_a_shield_inside_the_training_wrappers_counts_by_episode():
    env = brax.ShieldWrapper(Counter(), threat_of, 0.125)
    env = brax.wrap(env, 100)
    state, step = jax.jit(env.reset)(raws(0)), jax.jit(env.step)
    count, counted = np.zeros(ROWS), 0
    for _ in range(9):
        before = state
        state = step(state, jnp.full(ROWS, 2))
        count = np.where(before.done > 0, 0, count) + state.info["intervention"]
        np.testing.assert_array_equal(state.info["episode_metrics"]["intervention"], count)
        counted += count.sum()
    assert counted > 0


def test_a_shield_around_the_training_wrappers_does_what_one_inside_does():
    inside = brax.wrap(brax.ShieldWrapper(Counter(), threat_of, 0.125), 100)
    around = brax.ShieldWrapper(brax.wrap(Counter(), 100), jax.vmap(threat_of), 0.125)
    states = [jax.jit(env.reset)(raws(0)) for env in (inside, around)]
    steps = [jax.jit(env.step) for env in (inside, around)]
    for t in range(9):
        states = [step(s, jnp.full(ROWS, t % 4)) for step, s in zip(steps, states, strict=True)]
        for name in ("intervention", "insecure"):
            np.testing.assert_array_equal(states[0].info[name], states[1].info[name])
        same_bits(states[0].pipeline_state, states[1].pipeline_state)
    assert set(states[1].metrics) >= {"intervention", "insecure"}


@pytest.mark.parametrize("length", [0, -1, 2.5])
def test_episodes_without_a_step_are_refused(length):
    with pytest.raises(ValueError, match=rf"^episode_length is {length}; it must be an integer"):
        brax.wrap(made("circuit"), length)


def test_a_physics_backend_is_ignored():
    env = brax.envs.get_environment("rp_jax_jam", backend="generalized", num_obstacles=3)
    assert env.params.num_obstacles == 3
    assert env.backend == "rp_jax"


@pytest.mark.parametrize(
    "action", [jnp.zeros(3), jnp.zeros(()), jnp.asarray(True), jnp.zeros(2, int)]
)
def test_actions_of_another_shape_or_type_are_refused(action):
    env = made("circuit")
    state = jax.eval_shape(env.reset, raw(0))
    with pytest.raises(ValueError, match=r"^action is .*; it must be an integer or 2 floats"):
        jax.eval_shape(lambda s: env.step(s, action), state)


def test_randomised_parameters_are_refused():
    with pytest.raises(ValueError, match=r"^randomization_fn is given"):
        brax.wrap(made("circuit"), 10, randomization_fn=lambda sys: sys)


def test_repeated_actions_are_refused():
    with pytest.raises(ValueError, match=r"^action_repeat is 2; it must be .*1"):
        brax.wrap(made("circuit"), 10, action_repeat=2)


def test_what_jax_took_away_is_back_while_agents_train(monkeypatch):
    monkeypatch.delattr(jax, "device_put_replicated", raising=False)
    with brax.training_agents(), brax.training_agents():
        copies = jax.device_put_replicated({"a": jnp.arange(3), "b": 2.0}, jax.devices()[:1])
    same_bits(copies, {"a": np.arange(3)[None], "b": np.asarray([2.0])})
    with pytest.raises(KeyError), brax.training_agents():
        raise KeyError
    assert not hasattr(jax, "device_put_replicated")


def test_what_jax_still_has_is_left_alone(monkeypatch):
    monkeypatch.setattr(jax, "device_put_replicated", "jax's own", raising=False)
    with brax.training_agents():
        assert jax.device_put_replicated == "jax's own"
    assert jax.device_put_replicated == "jax's own"


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["ppo", "sac"])
def test_agents_of_brax_train(agent):
    if agent == "ppo":
        from brax.training.agents.ppo.train import train

        settings = {"batch_size": 16, "num_minibatches": 4, "unroll_length": 8}
    else:
        from brax.training.agents.sac.train import train

        settings = {"batch_size": 16, "min_replay_size": 64, "max_replay_size": 2048}
    told = []
    with brax.training_agents(), jax.numpy_rank_promotion("allow"):  # brax's agents need both
        make, weights, _ = train(
            environment=made("jam"),
            num_timesteps=2000,
            episode_length=100,
            wrap_env_fn=brax.wrap,
            num_envs=16,
            num_evals=2,
            num_eval_envs=8,
            progress_fn=lambda steps, metrics: told.append((steps, metrics)),
            **settings,
        )
    assert [steps for steps, _ in told][-1] >= 2000
    for _, metrics in told:
        assert 0 <= metrics["eval/episode_cost"] <= 1
        assert 0 < metrics["eval/avg_episode_length"] <= 100
    obs = jnp.zeros((3, made("jam").observation_size))
    action, _ = make(weights, deterministic=True)(obs, jax.random.key(0))
    assert (abs(action) <= 1).all()
