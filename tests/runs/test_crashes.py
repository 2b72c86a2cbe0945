"""Crashes looked at closely, on the corridor: what was risked and missed there is known."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest

from experiments import crashes
from experiments.crashes import Config
from rp_jax.planning.pmdp import PMDP

SIZES = {"episodes": 50, "most": 4, "steps": 3, "tries": 32, "checks": 400}


class Careless(PMDP):
    """Takes no action to be a threat, but the one that leaves the last cell before the pit."""

    def threat(self, states, alive=None):
        near = states.body.position[:, :1] >= 5
        rising = jnp.asarray([[0.2, 0.3, 0.4]])
        return jnp.where(near, rising, 0.0)


def make_careless(x=0.1):
    like = probe.make_pmdp(probe, probe.make_params(slip=0.2, time_limit=6), pool=1)
    fields = {name: getattr(like, name) for name in like.__dataclass_fields__}
    return Careless(**{**fields, "x": jnp.asarray(x, jnp.float32)})


def rightwards(percept):
    return jnp.tile(jnp.asarray([[0.0, 0.0, 1.0]]), (percept.secure.shape[0], 1))


def config(tmp_path, **changes):
    return Config(**{"run": tmp_path, "out": tmp_path / "out", **SIZES, **changes})


def test_each_crash_has_its_last_steps(tmp_path):
    pmdp = make_careless(x=1.0)  # walks into the pit
    found, count, episodes = crashes.found(jax.random.key(0), pmdp, rightwards, config(tmp_path))
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


def test_what_was_risked_and_what_was_missed(tmp_path):
    pmdp, settings = make_careless(x=1.0), config(tmp_path)
    found, _, _ = crashes.found(jax.random.key(0), pmdp, rightwards, settings)
    crash = next(crash for crash in found if crash.length >= 3)
    explore = crashes.explorer(pmdp, rightwards, settings)
    rows = crashes.looked_at(jax.random.key(1), crash, explore, settings)
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


def test_steps_without_an_admissible_action_are_counted(tmp_path):
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
    recording = crashes.evaluate.Recording(admissible=None, alive=None, **shown)
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
    [
        ("episodes", 0),
        ("most", 0),
        ("steps", 101),
        ("tries", 0),
        ("checks", 1.5),
        ("agent", -1),
        ("seed", -1),
    ],
)
def test_bad_settings_are_named(field, value, tmp_path):
    config(tmp_path).validate()
    with pytest.raises(ValueError, match=rf"^{field} is .*must"):
        config(tmp_path, **{field: value}).validate()


@pytest.mark.slow
def test_a_run_s_crashes_are_told_and_drawn(finished, tmp_path, capsys):
    from experiments import runs
    from rp_jax import storage

    loaded = runs.load(finished)
    folder = storage.new_folder(tmp_path / "out")
    told = crashes.run(config(tmp_path, run=finished, steps=2, most=2, checks=8), loaded, folder)
    assert json.loads((folder / "crashes.json").read_text()) == told
    assert told["episodes"] == 50
    assert len(told["looked_at"]) == min(2, told["crashes"])
    assert f"{told['crashes']} crashes of 50" in capsys.readouterr().out
    assert (folder / "crashes.png").exists() == (told["crashes"] > 0)
