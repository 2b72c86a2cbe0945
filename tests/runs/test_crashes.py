"""Crashes looked at closely, on the corridor: what was risked and missed there is known."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest

from rp_jax.cli import crashes_command
from rp_jax.planning.pmdp import PMDP
from rp_jax.recording import Recording
from rp_jax.runs import crashes
from rp_jax.runs.agents import Agent
from rp_jax.runs.crashes import CrashConfig

SIZES = CrashConfig(episodes=50, most=4, steps=3, tries=32, checks=400)


class Careless(PMDP):
    """Takes no action to be a threat, but the one that leaves the last cell before the pit."""

    def _total(self, states, alive=None):
        near = states.body.position[:, :1] >= 5
        rising = jnp.asarray([[0.2, 0.3, 0.4]])
        return jnp.where(near, rising, 0.0)


def make_careless(x=0.1):
    like = probe.make_pmdp(probe, probe.make_params(slip=0.2, time_limit=6), pool=1)
    fields = {name: getattr(like, name) for name in like.__dataclass_fields__}
    return Careless(**{**fields, "x": jnp.asarray(x, jnp.float32)})


class Eager(Agent):
    """Goes to the right whenever it may."""

    def values(self, percept):
        return jnp.tile(jnp.asarray([[0.0, 0.0, 1.0]]), (percept.secure.shape[0], 1))


def eager(x):
    return Eager(pmdp=make_careless(x), weights=None, network=None)


def test_each_crash_has_its_last_steps():
    found, count, episodes = crashes.found(jax.random.key(0), eager(1.0), SIZES)
    assert len(found) == 4
    assert episodes == 50
    assert 4 < count <= 50
    for crash in found:
        assert crash.hit == ["pit"]
        assert crash.secure.all()
        assert crash.insecure == 0
        cells = crash.states.body.position[:, 0]
        assert cells[-1] == 5
        assert (crash.action == probe.RIGHT).all()
        assert (np.diff(cells) >= 0).all()
        assert crash.states.time[-1] + 1 == crash.length
        assert crash.threat.shape == (min(3, crash.length), 3)


def test_a_crash_is_a_step_of_danger_whatever_is_being_hit():
    """As `evaluate` counts: a hazard of the world's own that no source knows is one as well."""

    class Muddy:
        """The corridor, where the second step is dangerous too, and nothing is hit by it."""

        def __getattr__(self, name):
            return getattr(probe, name)

        def __hash__(self):
            return 0

        def __eq__(self, other):
            return isinstance(other, Muddy)

        def step(self, key, state, action, params):
            reached, outcome = probe.step(key, state, action, params)
            danger = jnp.where(state.time == 1, 1.0, outcome.danger)
            return reached, outcome.replace(danger=danger)

    agent = eager(1.0)
    agent = agent.replace(pmdp=agent.pmdp.replace(env=Muddy()))
    found, count, episodes = crashes.found(jax.random.key(0), agent, SIZES)
    assert count == episodes  # every episode is longer than a step
    assert {crash.length for crash in found} == {2}
    assert {tuple(crash.hit) for crash in found} == {()}


def test_what_was_risked_and_what_was_missed():
    agent = eager(1.0)  # walks into the pit
    found, _, _ = crashes.found(jax.random.key(0), agent, SIZES)
    crash = next(crash for crash in found if crash.length >= 3)
    explore = crashes.explorer(agent.pmdp, agent.values, SIZES)
    rows = crashes.looked_at(jax.random.key(1), crash, explore, SIZES)
    assert [row["before"] for row in rows] == [3, 2, 1]
    last = rows[-1]
    # Going right falls in with .8 at once; else it tries again until the time is up.
    assert last["risk"] > 0.8
    assert last["best_action"] != probe.RIGHT
    assert last["best_risk"] <= last["risk"]
    assert min(row["best_risk"] for row in rows) < 0.9
    low, high = last["best_risk_ci95"]
    assert low <= last["best_risk"] <= high
    told = crashes.summed_up(rows, crash.insecure)
    assert told["entered"] == last["risk"]  # the last step was admissible
    most = max(rows, key=lambda row: row["seems_to_save"])
    assert told["missed"] == most["risk"] - most["best_risk"]
    assert all(row["seems_to_save"] >= 0 for row in rows)


def test_steps_without_an_admissible_action_are_counted():
    pmdp = make_careless(x=0.1)  # at cell 5 nothing is admissible, and the least threat is to stay
    states = jax.vmap(probe.start_at)(jnp.asarray([5.0]))
    percept = jax.jit(pmdp.perceive)(states)
    assert not percept.secure.any()
    shown = {
        "secure": np.asarray([[True], [True], [False], [False], [True]]),
        "action": np.zeros((5, 1), int),
        "threat": np.zeros((5, 1, 3)),
        "states": jax.tree.map(lambda a: np.zeros((5, 1)), states),
    }
    recording = Recording(admissible=None, alive=None, danger=None, **shown)
    crash = crashes.ending(recording, 0, 4, 3, ["pit"])
    assert (crash.length, crash.insecure) == (4, 2)
    np.testing.assert_array_equal(crash.secure, [True, False, False])
    rows = [
        {"before": 3, "secure": True, "risk": 0.4, "best_risk": 0.1, "seems_to_save": 0.2},
        {"before": 2, "secure": False, "risk": 0.6, "best_risk": 0.6, "seems_to_save": 0.3},
        {"before": 1, "secure": False, "risk": 0.9, "best_risk": 0.8, "seems_to_save": 0.25},
    ]
    told = crashes.summed_up(rows, 2)
    assert told == {"entered": 0.4, "missed_before": 2, "missed": 0.0}  # chosen by other episodes
    assert crashes.summed_up(rows[1:], 2)["entered"] is None


@pytest.mark.parametrize(
    ("field", "value"),
    [("episodes", 0), ("most", 0), ("steps", 101), ("tries", 0), ("checks", 1.5)],
)
def test_bad_settings_are_named(field, value):
    SIZES.validate()
    with pytest.raises(ValueError, match=rf"^{field} is .*must"):
        dataclasses.replace(SIZES, **{field: value}).validate()


def test_results_are_told_after_each_crash():
    told, small = [], dataclasses.replace(SIZES, most=2, checks=8, tries=4)
    keep = lambda found: told.append(len(found["looked_at"]))  # noqa: E731
    found = crashes.look_at_crashes(jax.random.key(0), eager(1.0), small, on_result=keep)
    assert told == [1, 2]
    assert (found["x"], found["episodes"]) == (1.0, 50)
    assert [crash["hit"] for crash in found["looked_at"]] == 2 * [["pit"]]
    low, high = found["crash_ci95"]
    assert low < found["crashes"] / 50 <= high


@pytest.mark.slow
def test_a_run_s_crashes_are_told_and_drawn(finished, tmp_path, capsys):
    out = tmp_path / "out"
    sizes = ["--episodes", "50", "--most", "2", "--steps", "2", "--tries", "32", "--checks", "8"]
    crashes_command.main(["--run", str(finished), "--out", str(out), *sizes])
    told = json.loads((out / "crashes.json").read_text())
    assert told["episodes"] == 50
    assert (told["env"], told["variant"]) == ("circuit", "circle")
    assert len(told["looked_at"]) == min(2, told["crashes"])
    assert f"{told['crashes']} crashes of 50" in capsys.readouterr().out
    assert (out / "crashes.png").exists() == (told["crashes"] > 0)
