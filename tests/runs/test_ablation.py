"""The comparison of shields, on the corridor."""

import json

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


def test_acting_at_random_tells_how_far_it_is(world):
    told = []
    ablation.untrained(
        KEY,
        *world,
        x=0.5,
        penalty=1.0,
        episodes=4,
        name="here",
        on_progress=lambda *n: told.append(n),
    )
    assert told == [
        ("evaluation here", 0, 2, "random"),
        ("evaluation here", 1, 2, "random, shield (x=0.5)"),
        ("evaluation here", 2, 2, ""),
    ]


def row(method, seed, returned, collisions):
    crashes = sum(collisions.values())
    return {
        "variant": "here",
        "method": method,
        "seed": seed,
        "episodes": 100,
        "return_mean": returned,
        "return_ci95": 0.5,
        "crashes": crashes,
        "crash_rate": crashes / 100,
        "crash_ci95": [0.0, 0.1],
        "goal_rate": 0.25,
        "collisions": collisions,
    }


TABLE = ablation.ShieldTable(
    [
        row("DQN", 0, 1.0, {"wall": 12, "obstacle": 3}),
        row("DQN", 1, 3.0, {"wall": 0, "obstacle": 1}),
        row("RP", 0, 8.0, {"wall": 0, "obstacle": 0}),
    ]
)


def test_the_table_says_what_was_hit_by_each_method():
    header, *lines = [line.split("  ") for line in str(TABLE).splitlines()]
    place = [cell.strip() for cell in header if cell.strip()].index("hit")
    shown = [[cell.strip() for cell in line if cell.strip()] for line in lines]
    assert shown[0][place] == "wall 12, obstacle 3"
    assert shown[1][place] == "obstacle 1"
    assert shown[2][place] == "0.250"  # nothing was hit: the goals come next
    assert [line[1] for line in shown] == ["DQN", "DQN", "RP"]


def test_the_summary_keeps_methods_apart(tmp_path):
    found = [(row["method"], row["seeds"], row["return_mean"]) for row in TABLE.summary]
    assert found == [("DQN", 2, 2.0), ("RP", 1, 8.0)]
    assert [row["crashes"] for row in TABLE.summary] == [16, 0]
    TABLE.write(tmp_path)
    written = json.loads((tmp_path / "summary.json").read_text())
    assert [row["method"] for row in written] == ["DQN", "RP"]


def test_each_method_has_a_bar_of_its_own():
    told = []
    ablation._named(lambda *n: told.append(n), "with shield")("planning", 1, 30, "note")
    assert told == [("planning, with shield", 1, 30, "note")]


@pytest.mark.slow
def test_all_kinds_of_agents_are_compared_with_the_settings_that_are_given(world):
    stages = []
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
        on_progress=lambda stage, *_: stages.append(stage),
    )
    free, held = agents
    assert list(dict.fromkeys(stages)) == [
        "planning, without shield",
        "planning, with shield",
        "evaluation here, at random",
        "evaluation here, without shield",
        "evaluation here, with shield",
    ]
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
