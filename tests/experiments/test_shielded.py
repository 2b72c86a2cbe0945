import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import unoptimised

from experiments import shielded
from rp_jax.envs import jam
from rp_jax.runs.plan import make_pmdp
from rp_jax.threat.function import ThreatFunction

TINY = "--{0}.states 200 --{0}.paths 4 --{0}.test-states 200 --{0}.test-paths 8 " + (
    "--{0}.fit.steps 40 --{0}.fit.batch 64 --{0}.fit.hidden 16"
)


@pytest.fixture(autouse=True, scope="module")
def programs_of_a_moment():
    """They need no optimising; brax's agents need rank promotion."""
    with unoptimised(), jax.numpy_rank_promotion("allow"):
        yield


def go(out, *options):
    argv = [TINY.format("obstacle"), "--baseline plans", *options]
    return shielded.main([*" ".join(argv).split(), "--out", str(out)])


def full_speed(env, params, config):
    act = lambda weights, obs, key: jnp.tile(weights, (len(obs), 1))  # noqa: E731
    return shielded.Policy(act, jnp.asarray([[1.0, 0.0]]), params.body.normalized_actions)


@pytest.mark.slow
def test_every_policy_is_played_without_the_shield_and_with_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(shielded, "ROUND", 8)
    monkeypatch.setattr(shielded, "learned", full_speed)
    folder = go(tmp_path / "new", "--obstacles 3 --episodes 12 --x 0.9")
    rows = json.loads((folder / "table.json").read_text())
    assert [(row["policy"], row["shield"]) for row in rows] == [
        ("random", "none"),
        ("random", "x = 0.9"),
        ("PPO", "none"),
        ("PPO, nearest row", "none"),
        ("PPO, nearest row", "x = 0.9"),
    ]
    for row in rows:
        assert row["episodes"] == 12
        low, high = row["crash_ci95"]
        assert low <= row["crash_rate"] == row["crashes"] / 12 <= high
        assert sum(row["collisions"].values()) >= row["crashes"]
        assert (row["interventions"] > 0) <= (row["shield"] != "none")
    # Straight ahead at full speed ends at the wall, if not before: with no shield to mind.
    assert rows[2]["crashes"] == rows[3]["crashes"] == 12
    np.testing.assert_allclose(rows[2]["return_mean"], rows[3]["return_mean"])
    assert (folder / "threat" / "manifest.json").exists()
    assert json.loads((folder / "config.json").read_text())["obstacles"] == 3
    assert "12 episodes each" in capsys.readouterr().out


def test_a_perfect_threat_of_walls_keeps_a_policy_off_them(monkeypatch):
    params = jam.make_params(3, baseline="plans")
    policy = full_speed(jam, params, None)
    pmdp = make_pmdp(WallsOnly, params, ThreatFunction({}, {}), x=0.5)
    monkeypatch.setattr(shielded, "ROUND", 50)
    play = jax.jit(lambda key: shielded.played(key, pmdp, policy.weights, policy, True))
    rows = play(jax.random.key(0))
    assert not rows.collisions["wall"].any()
    assert rows.interventions.sum() > 0


class WallsOnly:
    """Jam, whose obstacles are no hazard to its threat."""

    LIDAR_BINS, SCALE = jam.LIDAR_BINS, jam.SCALE
    reset, step, observe, collisions = jam.reset, jam.step, jam.observe, jam.collisions
    clearance, num_actions = jam.clearance, jam.num_actions

    @staticmethod
    def hazards(state, params):
        return {}

    @staticmethod
    def sub_rmdps(params):
        return {}


def test_bad_settings_are_refused_before_any_work(tmp_path, capsys):
    for options, message in (
        ("--steps 0", "steps is 0"),
        ("--episodes 0", "episodes is 0"),
        ("--x -1", "x is -1"),
        ("--obstacles 0", "num_obstacles is 0"),
        ("--baseline none", "baseline is 'none'"),
    ):
        with pytest.raises(SystemExit) as stop:
            go(tmp_path / "new", options)
        assert stop.value.code == 2
        assert message in capsys.readouterr().out
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_the_policy_is_learned_by_brax():
    params = jam.make_params(3)
    policy = shielded.learned(jam, params, shielded.Config(steps=4096))
    seen = jnp.zeros((2, jam.LIDAR_BINS + len(jam.SCALE)))
    assert policy.act(policy.weights, seen, jax.random.key(0)).shape == (2, 2)
