"""Evaluation in rounds, which can be interrupted."""

import dataclasses

import forked
import jax
import numpy as np
import pytest
from quick import compile_soon, stopped_after  # noqa: F401

from experiments import evaluation, tasks
from experiments.training import Trained
from rp_jax import evaluation
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.planning import loop


def test_rounds_are_those_of_an_evaluation_at_once_and_go_on_where_they_stopped(
    tmp_path, monkeypatch
):
    presets, make_task = forked.corridor()
    config = dataclasses.replace(presets["quick"]("tuned"), seeds=2, episodes=20)
    task = make_task(config)
    pmdp, members = tasks.make_pmdp(task, config, None, task.train), tasks.members_of(config)
    network = loop.make_network(config.planning, pmdp)
    weights = jax.vmap(lambda key: loop.begin(key, pmdp, config.planning).learner.params)(
        tasks.keys_of(members, tasks.PLANNING)
    )
    policy = evaluation.greedily(network)
    agents = evaluation.Agents(members, ["it", "it"], policy, Trained(weights, [], 0.0, 0.0))
    monkeypatch.setattr(evaluation, "ROUND", 8)

    def play(checkpoints):
        return evaluation.play_all(task, config, pmdp, agents, checkpoints)[1]

    found, kept = play(NO_CHECKPOINTS), Checkpoints(tmp_path / "kept", run="it")
    with stopped_after(4, monkeypatch), pytest.raises(KeyboardInterrupt):  # of 3 for each variant
        play(kept)
    jax.tree.map(np.testing.assert_array_equal, play(kept), found)
    assert list(found) == list(task.tests)
    for variant, rows in found.items():
        assert rows.score.shape == (2, 20)
        for i, key in enumerate(tasks.keys_of(members, tasks.EVALUATION)):
            own = jax.tree.map(lambda a, i=i: a[i], weights)
            there = pmdp.replace(params=task.tests[variant], x=np.float32(config.x))
            at_once = evaluation.play_episodes(key, there, policy(own), 20, batch=8)
            mine = jax.tree.map(lambda a, i=i: a[i], rows)
            jax.tree.map(np.testing.assert_array_equal, mine, at_once)
