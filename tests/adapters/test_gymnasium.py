import copy
import functools
import sys
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from quick import compile_soon  # noqa: F401

from rp_jax.adapters import gymnasium as adapter
from rp_jax.adapters import registry
from rp_jax.envs import autoreset

SPECIAL = {"jam": {"num_obstacles": 3}}
SETTINGS = {name: {"time_limit": 12, **SPECIAL.get(name, {})} for name in registry.ENVS}
IDS = {
    spec.kwargs["name"]: key
    for key, spec in gymnasium.registry.items()
    if key.startswith("rp_jax/")
}
ROWS = 6
every_env = pytest.mark.parametrize("name", registry.ENVS)


def make(name):
    return gymnasium.make(IDS[name], **SETTINGS[name])


def make_vec(name, rows=ROWS):
    return gymnasium.make_vec(IDS[name], num_envs=rows, **SETTINGS[name])


def actions(name, steps, rows=ROWS):
    count = registry.make(name)[0].num_actions(registry.make(name)[1])
    return np.random.default_rng(0).integers(count, size=(steps, rows))


def same_bits(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_environments_are_registered_under_their_names():
    assert set(IDS) == set(registry.ENVS)
    assert IDS["jam"] == "rp_jax/Jam-v0"


@every_env
def test_an_environment_passes_the_checks_of_gymnasium(name):
    check_env(make(name).unwrapped)


@every_env
def test_transitions_are_those_of_the_environment_bit_for_bit(name):
    env = make(name)
    inner = env.unwrapped
    task, params = inner.env, inner.params
    step, observe = jax.jit(task.step), jax.jit(task.observe)
    env.reset(seed=3)
    for action in actions(name, 10)[:, 0]:
        key = jax.random.split(inner._key)[1]
        reached, outcome = step(key, inner.state, jnp.asarray(action, jnp.int32), params)
        seen, reward, terminated, truncated, info = env.step(action)
        same_bits(inner.state, reached)
        np.testing.assert_array_equal(seen, observe(reached, params))
        assert (reward, terminated, truncated) == (
            outcome.reward,
            outcome.terminated,
            outcome.truncated,
        )
        assert info == {"cost": outcome.danger, "goal": outcome.goal}
        assert seen.flags.writeable
        if terminated or truncated:
            break


@functools.cache
def stepper(name):
    env = make_vec(name)
    task, params = env.env, env.params

    @jax.jit
    def advance(key, states, action):
        keys = jax.random.split(jax.random.split(key)[1], ROWS)
        carried, reached, outcome = autoreset.auto_reset_step(task, keys, states, action, params)
        look = jax.vmap(task.observe, (0, None))
        return carried, look(carried, params), look(reached, params), outcome

    return advance


# Two programs may differ in the last bits of sines and cosines.
close = functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6)


@every_env
def test_a_batch_takes_the_same_steps_and_keeps_what_an_episode_ended_with(name):
    env, ends = make_vec(name), {"terminated": 0, "truncated": 0}
    seen, info = env.reset(seed=0)
    assert info == {}
    assert seen in env.observation_space
    for action in actions(name, 30):
        args = env._key, env.states, action.astype(np.int32)
        carried, observed, last, outcome = stepper(name)(*args)
        seen, reward, terminated, truncated, info = env.step(action)
        same_bits(env.states, carried)
        close(seen, observed)
        np.testing.assert_array_equal(reward, outcome.reward)
        np.testing.assert_array_equal(terminated, outcome.terminated)
        np.testing.assert_array_equal(truncated, outcome.truncated)
        np.testing.assert_array_equal(info["cost"], outcome.danger)
        np.testing.assert_array_equal(info["goal"], outcome.goal)
        assert not (terminated & truncated).any()
        done = terminated | truncated
        assert ("final_obs" in info) == done.any()
        for row in np.flatnonzero(done):
            close(info["final_obs"][row], last[row])
            assert (seen[row] != last[row]).any()
            assert info["final_info"]["cost"][row] == outcome.danger[row]
        if done.any():
            assert all(info["final_obs"][row] is None for row in np.flatnonzero(~done))
            np.testing.assert_array_equal(info["_final_obs"], done)
        ends["terminated"] += terminated.sum()
        ends["truncated"] += truncated.sum()
    assert ends["truncated"] > 0
    assert (ends["terminated"] > 0) == (name != "point_gather")  # where nothing ends an episode


def test_a_batch_tells_what_gymnasiums_own_batches_tell():
    ours = make_vec("circuit", 2)
    theirs = SyncVectorEnv([lambda: make("circuit")] * 2, autoreset_mode=AutoresetMode.SAME_STEP)
    assert ours.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    for env in (ours, theirs):
        env.reset(seed=0)
    for t in range(12):  # at a standstill nothing is hit
        results = [env.step(np.full(2, 7)) for env in (ours, theirs)]
        infos = [result[-1] for result in results]
        for a, b in zip(*(result[:-1] for result in results), strict=True):
            assert a.shape == b.shape
        np.testing.assert_array_equal(results[0][3], t == 11)
    assert set(infos[0]) >= set(infos[1])
    assert set(infos[0]["final_info"]) == set(infos[1]["final_info"])
    for name in ("final_obs", "_final_obs", "_final_info"):
        assert infos[0][name].dtype == infos[1][name].dtype
        assert infos[0][name].shape == infos[1][name].shape


@every_env
def test_a_seed_repeats_everything_and_starts_differ_without_one(name):
    def play(env):
        steps = [env.step(action) for action in actions(name, 15)]
        return [step[0] for step in steps]

    env = make_vec(name)
    first, _ = env.reset(seed=5)
    one = play(env)
    second, _ = env.reset()
    assert (first != second).any(axis=1).all()
    same_bits(env.reset(seed=5)[0], first)
    same_bits(play(env), one)
    assert len(np.unique(first, axis=0)) == ROWS
    single = make(name)
    starts = [single.reset(seed=5)[0], single.reset()[0], single.reset(seed=5)[0]]
    same_bits(starts[0], starts[2])
    assert (starts[0] != starts[1]).any()


def test_statistics_of_episodes_are_recorded():
    env = gymnasium.wrappers.RecordEpisodeStatistics(make("circuit"))
    env.reset(seed=0)
    rewards = [env.step(7) for _ in range(12)]
    assert rewards[-1][-1]["episode"]["l"] == 12
    assert rewards[-1][-1]["episode"]["r"] == sum(step[1] for step in rewards)


def test_statistics_of_episodes_of_a_batch_are_recorded():
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(make_vec("jam"), buffer_length=1000)
    env.reset(seed=0)
    score, length, told = np.zeros(ROWS), np.zeros(ROWS, int), []
    for action in actions("jam", 40):
        _, reward, terminated, truncated, info = env.step(action)
        score, length, done = score + reward, length + 1, terminated | truncated
        if done.any():
            np.testing.assert_allclose(info["episode"]["r"][done], score[done], rtol=1e-5)
            np.testing.assert_array_equal(info["episode"]["l"][done], length[done])
            told += list(length[done])
        score, length = np.where(done, 0, score), np.where(done, 0, length)
    assert len(told) > ROWS


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (15, "between 15 and 15; it must be between 0 and 14"),
        (-1, "between -1 and -1"),
        (1.0, "float64 of shape"),
        (True, "bool of shape"),
        ([1], r"int64 of shape \(1,\); it must be integers of shape \(\)"),
        (None, "object of shape"),
    ],
)
def test_bad_actions_are_refused(action, message):
    env = make("circuit").unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match=f"^action is {message}"):
        env.step(action)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(ROWS - 1, int), rf"int64 of shape \({ROWS - 1},\); it must be integers of shape"),
        (np.zeros((ROWS, 1), int), "int64 of shape"),
        (np.zeros(ROWS), "float64 of shape"),
        (np.asarray([0] * (ROWS - 1) + [15]), "between 0 and 15"),
    ],
)
def test_bad_batches_of_actions_are_refused(action, message):
    env = make_vec("circuit")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=f"^action is {message}"):
        env.step(action)


def test_other_bad_input_is_refused():
    with pytest.raises(ValueError, match=r"^name is 'jem'"):
        adapter.JaxEnv("jem")
    with pytest.raises(ValueError, match=r"^num_envs is 0"):
        adapter.JaxVectorEnv("jam", 0)
    for env in (adapter.JaxEnv("circuit"), adapter.JaxVectorEnv("circuit", 2)):
        with pytest.raises(gymnasium.error.ResetNeeded, match="before reset"):
            env.step(np.zeros(getattr(env, "num_envs", ()), int))


def lake_threat(state):
    """LEFT is never dangerous, UP a little, the others are."""
    return np.asarray([0.0, 0.9, 0.8, 0.05]) + 0.0 * state


def test_a_shield_around_any_environment_replaces_and_tells():
    env = adapter.Shielded(gymnasium.make("FrozenLake-v1", is_slippery=False), lake_threat, 0.1)
    env.reset(seed=0)
    for wish, taken in (
        (0, 0),
        (1, 0),
        (3, 3),
        (np.int64(2), 0),
        (np.asarray([0.1, 9.0, 0.3, 0.2], np.float32), 3),
    ):
        *_, info = env.step(wish)
        assert env.unwrapped.lastaction == taken
        wished = np.argmax(wish) if np.ndim(wish) else wish
        assert info["intervention"] == (wished != taken)
        assert not info["insecure"]
        assert "prob" in info  # what the environment itself tells is kept


def test_a_shield_finds_the_state_where_it_is_told_to_and_never_lets_a_worse_action_pass():
    seen = []

    def threat(state):
        seen.append(state)
        return np.asarray([0.9, 0.8])

    env = gymnasium.make("CartPole-v1")
    env = adapter.Shielded(env, threat, 0.1, state=lambda inner: inner.state)
    env.reset(seed=0)
    state = env.unwrapped.state
    *_, info = env.step(0)
    np.testing.assert_array_equal(seen[0], state)
    assert info["intervention"]
    assert info["insecure"]


def test_a_shield_takes_the_nearest_admissible_row_of_a_continuous_action():
    table = np.asarray([[-2.0], [-1.0], [0.0], [1.0], [2.0]], np.float32)
    threat = lambda _: np.asarray([0.0, 0.0, 0.9, 0.9, 0.0])  # noqa: E731
    env = adapter.Shielded(gymnasium.make("Pendulum-v1"), threat, 0.1, table)
    env.reset(seed=0)
    for wish, taken, replaced in ((-1.2, -1.0, False), (0.3, -1.0, True), (0.9, 2.0, True)):
        *_, info = env.step(np.asarray([wish], np.float32))
        assert env.unwrapped.last_u == taken
        assert info["intervention"] == replaced


def test_ours_can_be_shielded_too():
    threat = lambda state: jnp.where(jnp.arange(15) < 10, 0.0, state.body.speed + 1.0)  # noqa: E731
    env = adapter.Shielded(make("jam"), threat, 0.5, state=lambda env: env.state)
    env.reset(seed=0)
    for _ in range(5):
        assert env.step(14)[-1]["intervention"]
    assert env.unwrapped.state.body.speed < 0  # it backs off, and was told to speed up


@pytest.mark.slow
def test_stable_baselines_learns_from_it():
    sb3 = pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")
    learner = sb3.DQN(
        "MlpPolicy", make("circuit"), learning_starts=50, buffer_size=500, seed=0, device="cpu"
    )
    assert learner.learn(400).num_timesteps == 400
    assert len(learner.ep_info_buffer) >= 400 // 12


def guarded_lake(threats):
    """A shielded lake in which threats do not depend on the state."""
    env = adapter.Shielded(gymnasium.make("FrozenLake-v1"), lambda _: threats, 0.1)
    env.reset(seed=0)
    return env


@pytest.mark.parametrize("wish", [0, np.zeros(4, np.float32)])
def test_threats_that_are_all_nan_stop_a_shield(wish):
    env = guarded_lake(np.full(4, np.nan))
    with pytest.raises(FloatingPointError, match=r"^threat: all 4 numbers are nan"):
        env.step(wish)


def test_scores_that_are_nan_stop_a_shield():
    env = guarded_lake(np.zeros(4))
    with pytest.raises(FloatingPointError, match=r"^action: 1 of 4 numbers are nan"):
        env.step(np.asarray([0.0, np.nan, 1.0, 0.0], np.float32))


@pytest.mark.parametrize("wish", [-1, 4, 99])
def test_an_action_that_is_none_is_refused_by_a_shield(wish):
    env = guarded_lake(np.zeros(4))
    with pytest.raises(ValueError, match=f"^action is {wish}; it must be an integer, at least 0"):
        env.step(wish)


def test_threats_of_other_actions_than_there_are_are_refused():
    env = guarded_lake(np.zeros(3))
    with pytest.raises(ValueError, match=r"^threat has shape \(3,\); it must be \(4,\)"):
        env.step(0)
    with pytest.raises(ValueError, match=r"^env: its actions are Box.*; they must be Discrete"):
        adapter.Shielded(gymnasium.make("Pendulum-v1"), lambda _: np.zeros(3), 0.1)


@every_env
def test_keywords_of_gymnasium_are_understood_and_the_limit_is_told(name):
    default = {"circuit": 200, "jam": 100, "point_gather": 15}[name]
    env = gymnasium.make(IDS[name], render_mode=None)
    assert env.spec.max_episode_steps == default
    assert gymnasium.spec(IDS[name]).max_episode_steps == default
    assert env.render_mode is None
    assert gymnasium.make(IDS[name], max_episode_steps=3).spec.max_episode_steps == 3
    batch = gymnasium.make_vec(IDS[name], 2, max_episode_steps=3, render_mode=None)
    assert batch.spec.max_episode_steps == 3
    batch.reset(seed=0)
    ends = [batch.step(np.full(2, 7))[3] for _ in range(6)]
    np.testing.assert_array_equal(np.stack(ends)[:, 0], [False, False, True] * 2)
    again = gymnasium.make_vec(batch.spec)
    assert again.num_envs == 2
    assert again.spec.max_episode_steps == 3


def test_a_limit_longer_than_the_default_one_counts_and_of_two_the_shorter():
    env = gymnasium.make(IDS["point_gather"], max_episode_steps=20)
    env.reset(seed=0)
    ends = [env.step(40)[3] for _ in range(20)]
    assert ends == [False] * 19 + [True]
    assert gymnasium.make_vec(IDS["circuit"], 1, time_limit=5).spec.max_episode_steps == 5
    with pytest.raises(
        ValueError, match=r"^max_episode_steps is 0; it must be an integer, above 0"
    ):
        gymnasium.make_vec(IDS["circuit"], 1, max_episode_steps=0)
    with pytest.raises(ValueError, match=r"^render_mode is 'human'; it must be None"):
        adapter.JaxEnv("circuit", render_mode="human")


def test_a_list_of_seeds_gives_each_row_its_own_start():
    env = make_vec("jam", 3)
    first, _ = env.reset(seed=[1, 2, 3])
    later = [env.step(np.full(3, 7))[0] for _ in range(3)]
    other, _ = env.reset(seed=(3, 2, 9))
    np.testing.assert_array_equal(other[:2], first[[2, 1]])
    assert (other[2] != first[0]).any()
    same_bits(env.reset(seed=np.asarray([1, 2, 3]))[0], first)
    same_bits([env.step(np.full(3, 7))[0] for _ in range(3)], later)
    fresh, _ = env.reset(seed=[1, None, 3])
    np.testing.assert_array_equal(fresh[[0, 2]], first[[0, 2]])
    assert (fresh[1] != first[1]).any()


@pytest.mark.parametrize(
    ("seed", "message"),
    [
        ([1, 2], "^seed has 2 entries; there must be one for each of 3"),
        ([1, 2, -1], "^seed is -1; it must be an integer, at least 0"),
        ([1, 2, 0.5], r"^seed is 0\.5; it must be an integer"),
    ],
)
def test_lists_of_seeds_that_do_not_fit_are_refused(seed, message):
    with pytest.raises(ValueError, match=message):
        make_vec("circuit", 3).reset(seed=seed)


def test_a_mask_resets_the_marked_rows_alone():
    env = make_vec("jam", 3)
    env.reset(seed=0)
    before = env.step(np.full(3, 7))[0]
    mask = np.asarray([False, True, False])
    after, _ = env.reset(seed=1, options={"reset_mask": mask})
    np.testing.assert_array_equal(after[~mask], before[~mask])
    assert (after[mask] != before[mask]).any()
    np.testing.assert_array_equal(env.states.time, [1, 0, 1])


@pytest.mark.parametrize(
    "mask", [np.ones(2, bool), np.ones(3, int), np.zeros(3, bool), [True, True, 1.0]]
)
def test_masks_that_do_not_fit_are_refused(mask):
    env = make_vec("circuit", 3)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"^options: reset_mask is .*; it must be bool of shape"):
        env.reset(options={"reset_mask": mask})


def test_a_mask_before_there_are_states_is_refused():
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset_mask is given before the first"):
        make_vec("circuit", 2).reset(options={"reset_mask": np.ones(2, bool)})


@every_env
def test_a_copy_steps_alike_and_apart(name):
    env = make(name)
    first, _ = env.reset(seed=0)
    twin = copy.deepcopy(env)
    moves = actions(name, 5)[:, 0]
    one = [env.step(action)[:4] for action in moves]
    two = [twin.step(action)[:4] for action in moves]
    same_bits(one, two)
    same_bits(env.reset(seed=0)[0], first)
    batch = make_vec(name, 2)
    batch.reset(seed=0)
    other = copy.deepcopy(batch)
    same_bits(batch.step(np.full(2, 7))[0], other.step(np.full(2, 7))[0])


def test_observations_stay_inside_their_space_however_long_an_episode_is():
    env = gymnasium.make(IDS["point_gather"], max_episode_steps=1000)
    env.reset(seed=0)
    for _ in range(450):
        seen, *_ = env.step(8)
    assert np.abs(seen).max() > 100  # the angle, which is not wrapped
    assert seen in env.observation_space


def test_observations_and_rewards_are_of_single_precision_in_double_precision():
    with jax.enable_x64(True):
        for name in registry.ENVS:
            check_env(make(name).unwrapped)
            env = make_vec(name)
            seen, _ = env.reset(seed=0)
            assert seen in env.observation_space
            for action in actions(name, 13):
                seen, reward, *_, info = env.step(action)
                assert seen.dtype == reward.dtype == np.float32
                assert seen in env.observation_space
            lasts = [last for last in info.get("final_obs", []) if last is not None]
            assert all(last.dtype == np.float32 for last in lasts)


@pytest.mark.filterwarnings("ignore:os.fork", "ignore::UserWarning")  # gymnasium tells errors so
@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not fork")
def test_workers_forked_after_jax_was_used_say_what_to_do():
    env = gymnasium.make_vec(
        IDS["circuit"], 2, vectorization_mode="async", vector_kwargs={"context": "fork"}
    )
    with pytest.raises(RuntimeError, match=r"^circuit: this process was forked .* 'spawn'"):
        env.reset(seed=0)
    env.close(terminate=True)


@pytest.mark.slow
def test_workers_that_are_spawned_step():
    env = gymnasium.make_vec(
        IDS["circuit"], 2, vectorization_mode="async", vector_kwargs={"context": "spawn"}
    )
    first, _ = env.reset(seed=0)
    assert first.shape == (2, 364)
    env.step(np.full(2, 7))
    env.close()


def guarded_cart(threat=lambda _: np.asarray([0.0, 0.9]), x=0.1, **others):
    return adapter.Shielded(gymnasium.make("CartPole-v1"), threat, x, **others)


def test_a_shield_needs_a_reset_before_it_asks_for_threats():
    with pytest.raises(gymnasium.error.ResetNeeded, match="step is called before reset"):
        guarded_cart(lambda state: 1 / 0).step(0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x": np.nan}, "^x is nan; it must be a number"),
        ({"x": "0.1"}, "^x is '0.1'; it must be a number"),
        ({"x": None}, "^x is None, and so is c; one of them must be given"),
        ({"c": -0.1}, r"^c is -0\.1; it must be a finite number"),
        ({"threat": None}, "^threat is None; it must be a function"),
    ],
)
def test_what_a_shield_is_made_of_is_checked_at_once(change, message):
    with pytest.raises(ValueError, match=message):
        guarded_cart(**change)


def test_a_shield_spends_what_was_promised_and_then_takes_the_least_threatening_action():
    """Threats .1 and .4: the second action costs .3 of the .7 that are left of c = .8."""
    env = guarded_cart(lambda _: np.asarray([0.1, 0.4]), x=None, c=0.8)
    for _ in range(2):  # each episode has a budget of its own
        env.reset(seed=0)
        for left, replaced in ((0.4, False), (0.1, False), (0.1, True)):
            info = env.step(1)[-1]
            assert info["intervention"] is replaced
            assert info["budget"] == pytest.approx(left)
            assert not info["insecure"]
        assert env.step(0)[-1]["budget"] == pytest.approx(0.1)  # what is least costs nothing
    capped = guarded_cart(lambda _: np.asarray([0.1, 0.4]), x=0.3, c=0.8)
    capped.reset(seed=0)
    assert capped.step(1)[-1]["intervention"]
    grim = guarded_cart(lambda _: np.asarray([0.9, 0.95]), x=None, c=0.8)
    grim.reset(seed=0)
    info = grim.step(1)[-1]
    assert info["insecure"]
    assert info["budget"] == 0.0


@pytest.mark.parametrize("table", [np.zeros((3, 2)), np.zeros(3), np.zeros((0, 1)), [[np.nan]]])
def test_a_table_that_does_not_fit_the_actions_is_refused(table):
    with pytest.raises(ValueError, match=r"^table has shape .*; its rows must be finite actions"):
        adapter.Shielded(gymnasium.make("Pendulum-v1"), lambda _: np.zeros(3), 0.1, table)


@pytest.mark.parametrize(
    ("threat", "x", "passes"),
    [
        (1.00000001e-3, 1e-3, False),  # equal to x in single precision
        (1e-3, 1e-3, True),
        (np.float32(1e-3), 1e-3, False),  # 1.00000005e-3
        (1e-3, 1.00000001e-3, True),
        (1e-60, 0.0, False),
        (1e300, np.inf, True),
    ],
)
def test_threats_are_compared_in_double_precision(threat, x, passes):
    env = guarded_cart(lambda _: [threat, 0.0], x)
    env.reset(seed=0)
    assert env.step(0)[-1]["intervention"] is not passes


def test_a_shield_can_be_made_again_from_its_specification_and_passes_the_checks():
    env = guarded_cart()
    again = gymnasium.make(env.spec)
    again.reset(seed=0)
    assert again.step(1)[-1]["intervention"]
    assert gymnasium.make(again.spec).spec == env.spec
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*is different from the unwrapped version.*")
        warnings.filterwarnings("ignore", message=".*A Box observation space m.* value is")
        check_env(env, skip_render_check=True)  # which needs pygame
    twin = copy.deepcopy(env)
    twin.reset(seed=0)
    assert twin.step(1)[-1]["intervention"]


class FromOne(gymnasium.Env):
    """Two actions, 1 and 2."""

    action_space = gymnasium.spaces.Discrete(2, start=1)
    observation_space = gymnasium.spaces.Discrete(1)

    def reset(self, *, seed=None, options=None):
        return 0, {}

    def step(self, action):
        self.taken = action
        return 0, 0.0, False, False, {}


def test_actions_that_do_not_begin_at_0_are_counted_from_their_first():
    env = adapter.Shielded(FromOne(), lambda _: [0.0, 0.9], 0.1)
    env.reset()
    for wish, replaced in ((1, False), (2, True), (np.asarray([0.0, 1.0]), True)):
        assert env.step(wish)[-1]["intervention"] == replaced
        assert env.unwrapped.taken == 1
    with pytest.raises(ValueError, match=r"^action is 0; it must be an integer, at least 1"):
        env.step(0)
