"""The comparison of shields, on the corridor."""

import jax
import probe
import pytest
from tiny import programs_of_a_moment  # noqa: F401

from rp_jax.planning.loop import LoopConfig
from rp_jax.runs import ablation
from rp_jax.threat.function import ThreatFunction

PLANNING = LoopConfig(steps=200, num_envs=8, batch=16, n_step=2, replay=128, replay_start=16)
KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def world():
    params = probe.make_params(slip=0.2)
    threat = ThreatFunction({"pit": probe.threat_model(params)}, probe.sub_rmdps(params))
    return probe, params, threat


def test_those_that_act_at_random_have_episodes_of_their_own_for_each_seed(world):
    def played(seed):
        rows = ablation.untrained(KEY, *world, x=0.5, penalty=1.0, episodes=64, seed=seed)
        assert [row["seed"] for row in rows] == [seed, seed]
        assert [row["method"] for row in rows] == ["random", "random, shield (x=0.5)"]
        return [row["return_mean"] for row in rows]

    assert played(0) == played(0)
    assert played(0) != played(1)


@pytest.mark.slow
def test_all_kinds_of_agents_are_compared_with_the_settings_that_are_given(world):
    agents, table = ablation.compare_shields(
        KEY,
        *world,
        x=0.5,
        penalty=3.0,
        lookahead=2,
        insecure_penalty=4.0,
        tests={"here": world[1]},
        seeds=[5],
        config=PLANNING,
        episodes=16,
    )
    free, held = agents
    assert not free.pmdp.shielded
    assert [member.learning_penalty for member in free.members] == [0.0, 3.0]
    assert (held.pmdp.lookahead, float(held.pmdp.insecure_penalty)) == (2, 4.0)
    assert [(row["method"], row["seed"]) for row in table] == [
        ("random", 5),
        ("random, shield (x=0.5)", 5),
        ("DQN (penalty 0)", 5),
        ("DQN (penalty 3)", 5),
        ("RP (x=0.5)", 5),
    ]
