import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from quick import unoptimised

from rp_jax import evaluation
from rp_jax.envs import tally
from rp_jax.planning import loop
from rp_jax.planning.dqn import DQNConfig
from rp_jax.planning.loop import LoopConfig
from rp_jax.planning.percept import Percept

PARAMS = probe.make_params()
CONFIG = LoopConfig(
    learner=DQNConfig(gamma=0.9, polyak=0.05, reward_scale=1.0),
    steps=6400,
    num_envs=32,
    batch=64,
    n_step=2,
    replay=3200,
    replay_start=320,
    explore_share=0.6,
)
PART = 50  # iterations of a chunk; CONFIG asks for four

TRACED = []  # the configuration of every chunk that was traced

start = jax.jit(loop.init, static_argnums=2)


@functools.partial(jax.jit, static_argnums=(2, 3))
def advance(state, pmdp, config, iterations):
    TRACED.append(config)
    return loop.chunk(state, pmdp, config, iterations)


def alike(a, b):
    return jax.tree.all(jax.tree.map(lambda x, y: bool((x == y).all()), a, b))


def keyless(state):
    return state._replace(key=jax.random.key_data(state.key))


@pytest.fixture(autouse=True)
def allow_rank_promotion():
    """Flashbax's sampling needs it."""
    with jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture
def compile_soon():
    with unoptimised():
        yield


METHODS = {
    "RP": {"x": 0.5},
    "DQN": {"x": np.inf},
    "penalised DQN": {"x": np.inf, "penalty": 10.0},
}


@functools.cache
def learned(method):
    """The P-MDP, the state after learning, and the sums of all metrics."""
    pmdp = probe.make_pmdp(probe, PARAMS, **METHODS[method])
    state, metrics = start(jax.random.key(1), pmdp, CONFIG)
    for _ in range(4):
        state, new = advance(state, pmdp, CONFIG, PART)
        metrics = jax.tree.map(jnp.add, metrics, new)
    return pmdp, state, metrics


def play(method):
    """What 50 greedy episodes come to."""
    pmdp, state, _ = learned(method)
    network = loop.make_network(CONFIG, pmdp)

    @jax.jit
    def episodes(params, pmdp):
        values = evaluation.action_values(network, params)
        return evaluation.run_episodes(jax.random.key(2), pmdp, values, 50, batch=50)

    return evaluation.summarise(episodes(state.learner.params, pmdp), 0.0)


def test_behind_the_shield_the_pit_is_never_entered_not_even_while_learning():
    _, _, metrics = learned("RP")
    assert metrics.steps == 6400 + 11 * 32  # the replay is filled first
    assert metrics.crashes == 0
    assert metrics.inadmissible == 0
    assert metrics.insecure == 0
    assert metrics.episodes > 500  # and not for want of trying
    found = play("RP")
    assert found["crashes"] == 0
    assert found["goal_rate"] == 1
    assert found["return_mean"] == 1


def test_a_penalty_teaches_to_avoid_the_pit_by_falling_into_it():
    _, _, metrics = learned("penalised DQN")
    assert metrics.crashes > 10
    assert metrics.inadmissible == 0  # without a shield nothing is
    found = play("penalised DQN")
    assert found["crashes"] == 0
    assert found["goal_rate"] == 1


def test_a_penalty_is_taken_wherever_nothing_is_admissible():
    _, state, _ = learned("RP")
    taken = []
    for insecure_penalty in (0.0, 2.0):
        for x in (0.5, -1.0):  # everything secure on the way, and nothing
            pmdp = probe.make_pmdp(probe, PARAMS, x=x, insecure_penalty=insecure_penalty)
            network = loop.make_network(CONFIG, pmdp)
            after, _ = loop.interact(jax.random.key(0), state, pmdp, network, CONFIG)
            taken.append(jax.tree.map(lambda a: np.asarray(a)[-1], after.window))
    free, free_lost, dear, dear_lost = taken
    np.testing.assert_array_equal(free.reward, dear.reward)
    expected = free_lost.reward - 2.0 * ~free_lost.terminated
    np.testing.assert_array_equal(dear_lost.reward, expected)


def test_without_shield_and_penalty_the_bait_is_taken():
    _, _, metrics = learned("DQN")
    assert metrics.crashes > 500
    found = play("DQN")
    assert found["crash_rate"] == 1
    assert found["return_mean"] == probe.make_params().bait


def test_scores_count_rewards_without_the_penalty():
    for method in METHODS:
        _, _, metrics = learned(method)
        ended_well = 1.0 * metrics.goals + PARAMS.bait * metrics.crashes
        assert metrics.score == pytest.approx(float(ended_well))
        assert metrics.goals + metrics.crashes <= metrics.episodes


def test_the_same_key_gives_the_same_bits():
    pmdp, state, _ = learned("RP")
    again, _ = start(jax.random.key(1), pmdp, CONFIG)
    for _ in range(4):
        again, _ = advance(again, pmdp, CONFIG, PART)
    assert alike(keyless(again), keyless(state))
    other, _ = start(jax.random.key(2), pmdp, CONFIG)
    other, _ = advance(other, pmdp, CONFIG, PART)
    first, _ = start(jax.random.key(1), pmdp, CONFIG)
    first, _ = advance(first, pmdp, CONFIG, PART)
    assert not alike(other.learner.params, first.learner.params)


def test_two_chunks_are_one_of_twice_the_length():
    pmdp, _, _ = learned("RP")
    begun, _ = start(jax.random.key(3), pmdp, CONFIG)
    whole, sums = advance(begun, pmdp, CONFIG, PART)
    half, first = advance(begun, pmdp, CONFIG, PART // 2)
    half, second = advance(half, pmdp, CONFIG, PART // 2)
    assert alike(keyless(half), keyless(whole))
    both = jax.tree.map(jnp.add, first, second)
    assert both.loss == pytest.approx(float(sums.loss), rel=1e-5)
    assert alike(both._replace(loss=sums.loss), sums)  # sums of losses are rounded


COUNTS = ("steps", "episodes", "crashes", "goals", "insecure", "inadmissible")
MANY = 1_999_000_000  # which float32 rounds to multiples of 128


def test_counts_are_exact_up_to_two_billion(monkeypatch, compile_soon):
    """A chunk that begins where a long one would be: what it adds is what it made."""
    pmdp = probe.make_pmdp(probe, PARAMS, x=1e-3)
    config = dataclasses.replace(CONFIG, num_envs=31, steps=31 * 40, replay=31 * 40)
    state, _ = start(jax.random.key(0), pmdp, config)
    alone = loop.chunk(state, pmdp, config, 30)[1]
    blank = loop.no_metrics

    def begun(dtype):
        return blank(dtype)._replace(**{name: jnp.asarray(MANY, jnp.int32) for name in COUNTS})

    monkeypatch.setattr(loop, "no_metrics", begun)
    late = loop.chunk(state, pmdp, config, 30)[1]
    assert alone.steps == 30 * 31
    assert alone.episodes > 0
    for name in COUNTS:
        assert getattr(late, name) == MANY + getattr(alone, name), name


def test_sums_of_a_long_chunk_do_not_drift():
    """80,000 iterations of 255 environments; added one by one, the returns come to 32,124,160."""
    blank = loop.no_metrics(jnp.float32)
    once = blank._replace(
        steps=jnp.asarray(255, jnp.int32), score=jnp.asarray(401.65), loss=jnp.asarray(0.1)
    )

    @jax.jit
    def long(once):
        step = lambda _, sums: loop.sums_with(sums, once)  # noqa: E731
        return jax.lax.fori_loop(0, 80_000, step, loop.Sums(blank, blank)).total

    total = long(once)
    assert total.steps == 20_400_000
    assert total.score == pytest.approx(80_000 * 401.65, rel=1e-7)
    assert total.loss == pytest.approx(8_000, rel=1e-7)


def test_seeds_side_by_side_learn_what_each_learns_alone(compile_soon):
    pmdp, _, _ = learned("RP")
    begun = [start(jax.random.key(k), pmdp, CONFIG)[0] for k in (1, 5)]
    states = jax.tree.map(lambda *a: jnp.stack(a), *begun)
    many = jax.jit(jax.vmap(loop.chunk, (0, None, None, None)), static_argnums=(2, 3))
    states, sums = many(states, pmdp, CONFIG, PART // 2)
    network = loop.make_network(CONFIG, pmdp)
    seen = pmdp.perceive(jax.vmap(probe.start_at)(jnp.arange(1.0, 6.0))).encoded
    for i, alone in enumerate(begun):
        alone, metrics = advance(alone, pmdp, CONFIG, PART // 2)
        params, mine = jax.tree.map(lambda a, i=i: a[i], (states.learner.params, sums))
        values, wanted = (network.apply(p, seen) for p in (params, alone.learner.params))
        np.testing.assert_allclose(values, wanted, atol=1e-3)
        assert (mine.steps, mine.crashes) == (metrics.steps, metrics.crashes) == (25 * 32, 0)
        np.testing.assert_allclose(mine.loss, metrics.loss, rtol=1e-2)


@pytest.mark.slow
def test_penalties_and_seeds_learn_as_one_program_what_each_learns_alone(compile_soon):
    """Penalised DQN: every Lagrange coefficient and seed at once."""
    config = dataclasses.replace(CONFIG, num_envs=8, batch=16, replay=160, replay_start=40)
    pmdp = probe.make_pmdp(probe, PARAMS, x=np.inf)
    sweep = jax.tree.map(lambda _: None, pmdp).replace(penalty=0)
    penalties = jnp.asarray([0.0, 10.0])
    keys = jax.random.split(jax.random.key(6), 2)

    def train(key, pmdp):
        state, _ = loop.init(key, pmdp, config)
        return loop.chunk(state, pmdp, config, 10)[1]

    grid = jax.vmap(jax.vmap(train, (0, None)), (None, sweep))
    metrics = jax.jit(grid)(keys, pmdp.replace(penalty=penalties))
    assert metrics.loss.shape == (2, 2)
    alone = jax.jit(train)
    for i, penalty in enumerate(penalties):
        for j, key in enumerate(keys):
            mine = alone(key, pmdp.replace(penalty=penalty))
            np.testing.assert_allclose(mine.loss, metrics.loss[i, j], rtol=1e-2)
            assert mine.crashes == metrics.crashes[i, j]
    assert (metrics.loss[0] != metrics.loss[1]).any()  # where someone fell


def test_one_program_fills_the_replay_and_then_learns(compile_soon):
    pmdp = probe.make_pmdp(probe, PARAMS)
    program = jax.jit(functools.partial(loop.chunk, pmdp=pmdp, config=CONFIG))
    begun = jax.jit(loop.begin, static_argnums=2)(jax.random.key(4), pmdp, CONFIG)
    assert (begun.iteration, begun.replay.current_index) == (-2, 0)
    early, opening = program(begun, iterations=CONFIG.opening, updates=0)
    early = loop.emptied(early, CONFIG)  # the windows hold one step of two, after the starts
    assert (early.iteration, early.replay.current_index) == (0, 0)
    state, metrics = program(early, iterations=CONFIG.filling, updates=0)
    assert (state.iteration, state.replay.current_index) == (10, 320)
    assert (opening.steps, metrics.steps, metrics.loss) == (32, 10 * 32, 0)
    assert state.learner.updates == 0
    assert alike(state.learner.params, begun.learner.params)
    state, metrics = program(state, iterations=3, updates=1)
    assert (state.iteration, state.learner.updates, metrics.steps) == (13, 3, 96)
    assert metrics.loss > 0
    assert program._cache_size() == 1


def test_a_chunk_is_compiled_once_whatever_the_values():
    learned("RP")
    before = len(TRACED)
    for x, penalty, bait in ((0.5, 0.0, 3.0), (0.1, 2.0, 5.0), (np.inf, 7.0, 0.0)):
        models = {"pit": probe.threat_model(PARAMS)}
        pmdp = probe.make_pmdp(probe, probe.make_params(bait=bait), x, penalty, models)
        state, _ = start(jax.random.key(1), pmdp, CONFIG)
        for _ in range(3):
            state, _ = advance(state, pmdp, CONFIG, PART)
    assert before > 0
    assert len(TRACED) == before


def test_no_key_is_used_twice(monkeypatch):
    used = []

    def note(key):
        used.append(tuple(np.asarray(jax.random.key_data(key)).tolist()))

    def act(key, state, *_):
        note(key)
        return state, loop.LoopMetrics(*[0.0] * 12)

    def learn(key, state, *_):
        note(key)
        return state, 0.0

    monkeypatch.setattr(loop, "make_network", lambda *_: None)
    monkeypatch.setattr(loop, "make_replay", lambda _: SimpleNamespace(add=lambda kept, _: kept))
    monkeypatch.setattr(loop, "_oldest", lambda *_: None)
    monkeypatch.setattr(loop, "interact", act)
    monkeypatch.setattr(loop, "learn", learn)
    blank = dict.fromkeys(loop.LoopState._fields, jnp.zeros(()))
    running = tally.Running(jnp.zeros(()), jnp.zeros(()))
    state = loop.LoopState(**{**blank, "running": running, "key": jax.random.key(0)})
    with jax.disable_jit():
        loop.chunk(state, None, dataclasses.replace(CONFIG, updates=2), 5)
    assert len(used) == 5 * 3
    assert len(set(used)) == len(used)


def items(state):
    """The transitions in the replay, (n, ...)."""
    assert not state.replay.is_full
    count = int(state.replay.current_index)
    return count, jax.tree.map(lambda a: np.asarray(a)[0, :count], state.replay.experience)


def test_the_replay_holds_what_happened_and_no_more():
    """Every transition against what it must be, found from its two ends alone."""
    pmdp, _, _ = learned("RP")
    pmdp = pmdp.replace(params=probe.make_params(time_limit=5))
    state, _ = start(jax.random.key(4), pmdp, CONFIG)
    state, _ = advance(state, pmdp, CONFIG, PART)
    count, kept = items(state)
    assert count == 320 + PART * 32
    (cell, time), (to, then) = kept.encoded.rest.T, kept.next_encoded.rest.T
    gamma, length = CONFIG.learner.gamma, then - time
    assert set(np.unique(kept.action)) == {0, 1, 2}
    ended, late = to <= probe.COIN, then == 5
    assert 0 < ended.mean() < 1
    assert ((cell > probe.COIN) & (cell < probe.PIT) & (to < probe.PIT)).all()
    # It leads to a true end, to the time limit, or two steps on; never to a fresh start.
    assert set(np.unique(length)) == {1, 2}
    assert (ended | late)[length == 1].all()
    assert (late & ~ended & (length == 1)).any()
    # A time limit bootstraps, an end does not.
    np.testing.assert_allclose(kept.discount, np.where(ended, 0, gamma**length), rtol=1e-5)
    np.testing.assert_allclose(kept.reward, np.where(ended, gamma ** (length - 1), 0), rtol=1e-5)
    # What is admissible where it led: not to the right, beside the pit.
    wanted = np.where((to == 5)[:, None], [True, True, False], [True, True, True])
    np.testing.assert_array_equal(kept.next_admissible, wanted)


@pytest.mark.parametrize("prioritised", [False, True])
def test_nothing_of_half_filled_windows_is_in_the_replay(prioritised, monkeypatch, compile_soon):
    """Everyone walks to the pit, and after a fresh start again; four steps, by hand."""
    always = lambda *_: jnp.asarray(probe.RIGHT, jnp.int32)  # noqa: E731
    monkeypatch.setattr(loop, "_choose", always)
    config = dataclasses.replace(CONFIG, n_step=3, replay_start=64, prioritised=prioritised)
    assert (config.opening, config.filling) == (3, 2)
    pmdp = probe.make_pmdp(probe, probe.make_params(slip=0.0), 0.5, penalty=1.0)
    state, metrics = jax.jit(lambda key: loop.init(key, pmdp, config))(jax.random.key(12))
    assert (state.iteration, metrics.steps) == (2, 4 * 32)
    count, kept = items(state)
    assert count == 64  # the windows of steps 0 to 2, then those of steps 1 to 3
    starts = kept.encoded.rest[:32, 0]
    # start: (cell, time, cell reached, time then, reward, discount) of both windows. The pit at 6
    # pays 3 - 1; gamma is .9.
    by_hand = {
        2: [(2, 0, 5, 3, 0.0, 0.9**3), (3, 1, 6, 4, 0.81 * 2, 0.0)],
        3: [(3, 0, 6, 3, 0.81 * 2, 0.0), (4, 1, 6, 3, 0.9 * 2, 0.0)],
        4: [(4, 0, 6, 2, 0.9 * 2, 0.0), (5, 1, 6, 2, 2.0, 0.0)],
    }
    assert set(starts) == set(by_hand)
    wanted = [by_hand[int(start)][window] for window in (0, 1) for start in starts]
    found = [
        kept.encoded.rest,
        kept.next_encoded.rest,
        kept.reward[:, None],
        kept.discount[:, None],
    ]
    np.testing.assert_allclose(np.concatenate(found, axis=1), wanted, rtol=1e-6)
    assert (kept.action == probe.RIGHT).all()
    # At the pit's edge not to the right; in it nothing is admissible but the first of equals.
    masks = {5: [True, True, False], 6: [True, False, False]}
    np.testing.assert_array_equal(kept.next_admissible, [masks[row[2]] for row in wanted])


def test_the_replay_starts_with_the_asked_number_of_transitions(compile_soon):
    config = dataclasses.replace(CONFIG, n_step=1, replay_start=500)
    models = {"pit": probe.threat_model(PARAMS)}
    pmdp = probe.make_pmdp(probe, probe.make_params(slip=0.0), np.inf, 10.0, models)
    state, metrics = start(jax.random.key(5), pmdp, config)
    count, kept = items(state)
    assert count == metrics.steps == 512  # whole steps of all environments
    way = np.asarray([0, -1, 1])[kept.action]
    np.testing.assert_array_equal(kept.next_encoded.rest[:, 0] - kept.encoded.rest[:, 0], way)
    # Penalties are learned from, and not scored.
    fell = kept.next_encoded.rest[:, 0] == probe.PIT
    np.testing.assert_array_equal(kept.reward[fell], 3.0 - 10.0)
    assert (kept.discount[fell] == 0).all()
    assert metrics.crashes == fell.sum() > 0
    assert metrics.score == 3 * metrics.crashes + metrics.goals


def test_the_observation_at_a_time_limit_is_that_of_the_reached_state():
    still = probe.make_params(slip=1.0, time_limit=3)  # nobody moves, so all episodes time out
    pmdp = probe.make_pmdp(probe, still, 0.5)
    state, metrics = start(jax.random.key(6), pmdp, CONFIG)
    _, kept = items(state)
    (cell, time), (to, then) = kept.encoded.rest.T, kept.next_encoded.rest.T
    np.testing.assert_array_equal(cell, to)
    found = {(a, b, round(float(d), 4)) for a, b, d in zip(time, then, kept.discount, strict=True)}
    assert found == {(0, 2, 0.81), (1, 3, 0.81), (2, 3, 0.9)}
    assert (state.states.time < 3).all()  # while the environments have gone on afresh
    assert metrics.episodes == 32 * (11 // 3)


def test_the_carried_view_is_that_of_the_carried_states():
    pmdp, state, _ = learned("RP")
    percept = jax.jit(pmdp.perceive)(state.states)
    assert alike(percept.encoded, state.seen.encoded)
    np.testing.assert_array_equal(percept.threat, state.seen.threat)
    np.testing.assert_array_equal(state.seen.admissible, percept.admissible)
    assert state.seen.admissible.dtype == bool


@pytest.mark.parametrize(
    ("threat", "action", "x", "wrong"),
    [
        ([0.0, 0.2, 0.9], 0, 0.1, False),
        ([0.0, 0.2, 0.9], 1, 0.1, True),
        ([0.1, 0.2, 0.9], 0, 0.1, False),  # equal to x is admissible
        ([0.3, 0.2, 0.9], 1, 0.1, False),  # nothing is admissible: the least is right
        ([0.3, 0.2, 0.9], 0, 0.1, True),
        ([0.2, 0.2, 0.9], 1, 0.1, False),  # either of two least ones
        ([0.3, 0.2, 0.9], 2, np.inf, False),
        ([np.nan, 0.0, 0.9], 0, 0.1, True),
    ],
)
def test_an_inadmissible_action_is_known_by_its_threat(threat, action, x, wrong):
    threats, thresholds = jnp.asarray([threat, threat]), jnp.asarray([x, x])
    seen = Percept(None, None, None, threats, thresholds)
    found = loop._inadmissible(seen, jnp.asarray([action, action]))
    np.testing.assert_array_equal(found, [wrong, wrong])


def test_inadmissible_actions_are_counted_if_there_are_any(compile_soon):
    pmdp, _, _ = learned("RP")
    state, _ = start(jax.random.key(7), pmdp, CONFIG)
    beside = jax.vmap(probe.start_at)(jnp.full(32, 5.0))
    # A mask that lets all walk into the pit.
    forged = jnp.tile(jnp.arange(3) == probe.RIGHT, (32, 1))
    honest = jax.jit(type(pmdp).perceive)(pmdp, beside)
    seen = honest._replace(admissible=forged)
    forced = state._replace(states=beside, seen=seen)
    network = loop.make_network(CONFIG, pmdp)
    act = jax.jit(loop.interact, static_argnums=(3, 4))
    _, metrics = act(jax.random.key(8), forced, pmdp, network, CONFIG)
    assert metrics.inadmissible == 32
    assert 16 < metrics.crashes <= 32  # some slip
    fair = forced._replace(seen=honest)
    _, metrics = act(jax.random.key(8), fair, pmdp, network, CONFIG)
    assert metrics.inadmissible == metrics.crashes == 0


def test_states_without_admissible_actions_are_counted():
    pmdp = learned("RP")[0].replace(x=jnp.asarray(-1.0, jnp.float32))  # less than any threat
    _, metrics = start(jax.random.key(9), pmdp, CONFIG)
    assert metrics.insecure == metrics.steps == 11 * 32
    assert metrics.inadmissible == 0  # the least threatening one is right then
    assert metrics.crashes == 0


def test_the_paper_s_network_learns_from_the_smallest_prioritised_replay(compile_soon):
    learner = DQNConfig(gamma=0.9, anneal=False, polyak=0.0, period=3)
    config = dataclasses.replace(
        CONFIG,
        network="paper",
        learner=learner,
        n_step=1,
        replay=64,
        replay_start=33,
        prioritised=True,
    )
    config.validate("planning")
    pmdp = probe.make_pmdp(probe, PARAMS, 0.5, pool=1)
    state, _ = start(jax.random.key(10), pmdp, config)
    after, metrics = advance(state, pmdp, config, 10)
    assert after.learner.updates == 10
    assert np.isfinite(metrics.loss)
    assert metrics.loss > 0
    assert metrics.inadmissible == metrics.crashes == 0
    assert not alike(after.learner.params, state.learner.params)
    # Priorities are no longer all alike: errors have been written.
    tree = after.replay.sum_tree_state
    leaves = np.asarray(tree.nodes)[2**tree.tree_depth - 1 :]
    assert (leaves > 0).sum() == 64
    assert len(np.unique(leaves)) > 20


@pytest.mark.parametrize("n_step", [1, 3])
def test_priorities_stand_where_transitions_do(n_step, compile_soon):
    config = dataclasses.replace(
        CONFIG, n_step=n_step, replay=128, replay_start=33, prioritised=True
    )
    pmdp = probe.make_pmdp(probe, PARAMS, 0.5)
    state, _ = start(jax.random.key(11), pmdp, config)
    tree = state.replay.sum_tree_state
    leaves = np.asarray(tree.nodes)[2**tree.tree_depth - 1 :][:128]
    assert (leaves[:64] > 0).all()  # two steps of 32 environments are stored
    assert (leaves[64:] == 0).all()
    assert state.replay.current_index == state.replay.running_index == 64


def test_exploration_falls_to_its_end_and_stays():
    config = dataclasses.replace(CONFIG, explore_from=0.8, explore_to=0.2, explore_share=0.5)
    assert config.iterations == 200
    found = [float(loop.exploration(jnp.asarray(i), config)) for i in (0, 50, 100, 150, 200, 999)]
    np.testing.assert_allclose(found, [0.8, 0.5, 0.2, 0.2, 0.2, 0.2], rtol=1e-6)
    short = dataclasses.replace(config, steps=32, explore_share=1e-3)
    assert loop.exploration(jnp.asarray(0), short) == pytest.approx(0.8)
    assert loop.exploration(jnp.asarray(1), short) == pytest.approx(0.2)


def test_choices_are_greedy_or_uniform_inside_the_mask():
    values, mask = jnp.asarray([1.0, 5.0, 9.0]), jnp.asarray([True, True, False])
    keys = jax.random.split(jax.random.key(11), 2000)
    choose = jax.jit(jax.vmap(loop._choose, (0, None, None, None)))
    assert (choose(keys, values, mask, 0.0) == 1).all()
    always = np.bincount(choose(keys, values, mask, 1.0), minlength=3) / 2000
    np.testing.assert_allclose(always, [0.5, 0.5, 0.0], atol=0.05)
    half = np.bincount(choose(keys, values, mask, 0.5), minlength=3) / 2000
    np.testing.assert_allclose(half, [0.25, 0.75, 0.0], atol=0.05)


def test_sizes_follow_from_the_settings():
    assert CONFIG.samples_per_step == 2
    assert dataclasses.replace(CONFIG, steps=6401).iterations == 201
    assert dataclasses.replace(CONFIG, updates=3).samples_per_step == 6


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"network": "huge"}, "network"),
        ({"num_envs": 0}, "num_envs"),
        ({"steps": 31}, "steps"),
        ({"steps": -1}, "steps"),
        ({"batch": 0}, "batch"),
        ({"updates": 0}, "updates"),
        ({"n_step": 0}, "n_step"),
        ({"n_step": 101}, "n_step"),
        ({"replay": 63}, "replay"),
        ({"replay": 64, "replay_start": 65}, "replay_start"),
        ({"replay": 70, "replay_start": 65}, "replay_start"),
        ({"replay_start": 0}, "replay_start"),
        ({"priority_exponent": 1.1}, "priority_exponent"),
        ({"importance": -0.1}, "importance"),
        ({"explore_from": 1.5}, "explore_from"),
        ({"explore_to": float("nan")}, "explore_to"),
        ({"explore_share": 0.0}, "explore_share"),
        ({"learner": DQNConfig(gamma=2.0)}, r"learner\.gamma"),
    ],
)
def test_bad_settings_are_named(change, field):
    CONFIG.validate("planning")
    with pytest.raises(ValueError, match=rf"^planning\.{field} is .*must"):
        dataclasses.replace(CONFIG, **change).validate("planning")
