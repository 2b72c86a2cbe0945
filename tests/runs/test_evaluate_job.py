"""Evaluation in rounds, which can be interrupted."""

import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from quick import compile_soon, stopped_after  # noqa: F401

from rp_jax import evaluation
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.planning import loop
from rp_jax.planning.loop import LoopConfig
from rp_jax.runs import evaluate
from rp_jax.runs.agents import Member, with_member
from rp_jax.runs.evaluate import Players
from rp_jax.streams import Stream, key_of, numbered

MEMBERS = (Member(0, 0.5, 0.0), Member(3, 0.9, 0.0))
PLANNING = LoopConfig(steps=8, num_envs=8, batch=8, replay=64, replay_start=8)


@pytest.fixture(scope="module")
def pmdp():
    return probe.make_pmdp(probe, probe.make_params(slip=0.3))


@pytest.fixture(scope="module")
def players(pmdp):
    start = jax.vmap(lambda key: loop.begin(key, pmdp, PLANNING).learner.params)
    weights = start(jax.random.split(jax.random.key(1), 2))
    policy = evaluate.greedily(loop.make_network(PLANNING, pmdp))
    return Players(MEMBERS, ["it", "it"], policy, weights)


def test_rounds_are_those_of_an_evaluation_at_once_and_go_on_where_they_stopped(
    pmdp, players, tmp_path, monkeypatch
):
    monkeypatch.setattr(evaluate, "ROUND", 8)
    key = jax.random.key(5)

    def play(checkpoints):
        return evaluate.play_all(key, pmdp, players, 20, checkpoints=checkpoints)

    found, kept = play(NO_CHECKPOINTS), Checkpoints(tmp_path / "kept", run="it")
    with stopped_after(2, monkeypatch), pytest.raises(KeyboardInterrupt):  # of 3
        play(kept)
    jax.tree.map(np.testing.assert_array_equal, play(kept), found)
    assert found.score.shape == (2, 20)
    keys = numbered(key_of(key, Stream.EVALUATION), [member.seed for member in MEMBERS])
    for i, (own, member) in enumerate(zip(keys, MEMBERS, strict=True)):
        weights = jax.tree.map(lambda a, i=i: a[i], players.weights)
        there = with_member(pmdp, member)
        at_once = evaluation.play_episodes(own, there, players.policy(weights), 20, batch=8)
        mine = jax.tree.map(lambda a, i=i: a[i], found)
        jax.tree.map(np.testing.assert_array_equal, mine, at_once)


def test_players_of_one_number_play_the_same_episodes(pmdp, players):
    twins = players._replace(
        members=(MEMBERS[0], MEMBERS[0]),
        weights=jax.tree.map(lambda a: jnp.stack([a[0], a[0]]), players.weights),
    )
    found = evaluate.play_all(jax.random.key(5), pmdp, twins, 10)
    jax.tree.map(lambda a: np.testing.assert_array_equal(a[0], a[1]), found)


def test_a_row_has_the_threshold_only_under_a_shield(pmdp, players):
    rows = evaluate.play_all(jax.random.key(5), pmdp, players, 10)
    for shielded, thresholds in ((True, [0.5, 0.9]), (False, [float("inf")] * 2)):
        there = pmdp.replace(shielded=shielded)
        found = evaluate.scored(rows, there, players, 2.0, {"variant": "a"})
        assert [row["x"] for row in found] == thresholds
        assert [(row["variant"], row["seed"]) for row in found] == [("a", 0), ("a", 3)]


def test_decisions_are_timed_one_after_another(pmdp, players):
    act = evaluate.acting(pmdp, players.policy, jax.tree.map(lambda a: a[0], players.weights))
    states = []

    def told(state):
        states.append(int(state.time))
        return act(state)

    found = evaluate.timed(jax.random.key(0), probe, pmdp.params, told, actions=20)
    assert found.wall > 0
    assert found.cpu > 0
    assert len(states) == 21  # the first one compiles
    assert states[1:3] == [0, 1]
    assert states.count(0) > 2  # episodes end, and others begin
