import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quick import compile_soon  # noqa: F401 (a fixture for all of this file)

from benchmarks.measure import Row
from benchmarks.peers import __main__ as peers
from benchmarks.peers import environments, numpy_jam, rejax_dqn
from rp_jax.dynamics import Control, angle_of, make_vehicle
from rp_jax.envs import jam

ROW = Row("theirs", "agent steps", 1, 2.0, 1.0, 4.0, 0.0, 100.0)


def vehicles(rng, speeds, *shape):
    """(..., 4) anywhere in the room and a little beyond."""
    place, angle = rng.uniform(0.0, 3.1, (*shape, 2)), rng.uniform(-np.pi, np.pi, (*shape, 1))
    return np.concatenate([place, angle, rng.choice(speeds, (*shape, 1))], axis=-1)


def as_vehicle(rows):
    return make_vehicle(rows[..., :2], rows[..., 2], rows[..., 3])


def as_rows(vehicle):
    angle = angle_of(vehicle.heading)
    return np.concatenate([vehicle.position, np.stack([angle, vehicle.speed], axis=-1)], axis=-1)


def close(ours, theirs):
    """Angles may differ by full turns."""
    for column in (0, 1, 3):
        np.testing.assert_allclose(ours[..., column], theirs[..., column], atol=1e-9)
    np.testing.assert_allclose(np.cos(ours[..., 2] - theirs[..., 2]), 1, atol=1e-9)


@pytest.mark.usefixtures("x64")
def test_the_numpy_step_is_ours_transition_for_transition():
    rng, params = np.random.default_rng(0), jam.make_params()
    transition, observe = jax.jit(jam.transition), jax.jit(jam.observe)
    seen = {"crashed": 0, "goal": 0, "gone": 0, "safe": 0}
    for trial in range(100):
        body = vehicles(rng, jam.SPEEDS)
        if trial % 4 == 0:
            body[:2] = 2.6 + rng.uniform(-0.2, 0.2), 2.95
        others = vehicles(rng, jam.OBSTACLE_SPEEDS, 8)
        drive = np.stack([rng.choice(v, 8) for v in (jam.ACCELERATIONS, jam.OBSTACLE_TURNS)], -1)
        relocated, action = vehicles(rng, jam.OBSTACLE_SPEEDS, 8), int(rng.integers(15))
        state = numpy_jam.State(body, others, numpy_jam._progress(body), int(rng.integers(100)))
        mine = jam.start_at(as_vehicle(body), as_vehicle(others), params)
        mine = mine.replace(time=jnp.asarray(state.time, jnp.int32))
        turn = np.stack([np.cos(drive[:, 1]), np.sin(drive[:, 1])], axis=-1)
        draws = jam.Draws(
            Control(jnp.asarray(drive[:, 0]), jnp.asarray(turn)), as_vehicle(relocated)
        )
        reached, outcome = transition(mine, jnp.asarray(action), draws, params)
        moved, obstacles, gone = numpy_jam.move(state, action, drive)
        obstacles[gone] = relocated[gone]
        found = numpy_jam.finished(state, moved, obstacles)
        close(as_rows(reached.body), found.state.body)
        close(as_rows(reached.obstacles), found.state.obstacles)
        assert float(outcome.reward) == pytest.approx(found.reward)
        assert float(reached.progress) == found.state.progress
        assert (bool(outcome.danger), bool(outcome.goal)) == (found.crashed, found.goal)
        assert (bool(outcome.done), int(reached.time)) == (found.done, found.state.time)
        ours, theirs = np.asarray(observe(reached, params)), numpy_jam.observe(found.state)
        np.testing.assert_allclose(ours, theirs, atol=1e-6)
        seen["crashed"] += found.crashed
        seen["goal"] += found.goal
        seen["gone"] += bool(gone.any())
        seen["safe"] += not found.done
    assert min(seen.values()) > 2, seen


def test_numpy_episodes_begin_and_end():
    rng = np.random.default_rng(1)
    state = numpy_jam.reset(rng)
    away = np.hypot(*(state.obstacles[:, :2] - state.body[:2]).T)
    assert (away >= jam.CLEARANCE).all()
    for _ in range(200):
        found = numpy_jam.step(rng, state, 7)
        assert found.state.time == state.time + 1
        assert numpy_jam.observe(found.state).shape == (396,)
        state = numpy_jam.reset(rng) if found.done else found.state


def test_the_adapter_shows_what_our_network_sees():
    env = rejax_dqn.Jam(lambda n: n, lambda low, high, shape, dtype: shape)
    params = env.default_params
    assert (env.action_space(params), env.observation_space(params)) == (15, (81,))
    seen, state = jax.jit(env.reset)(jax.random.key(0), params)
    assert seen.shape == (81,)
    assert (np.asarray(seen[:45]) >= 0).all()
    late = state.replace(time=jnp.asarray(99, jnp.int32))
    step, look = jax.jit(env.step), jax.jit(env._seen)
    for start, ended in ((state, False), (late, True)):
        seen, after, _, done, _ = step(jax.random.key(1), start, jnp.asarray(7), params)
        assert bool(done) is ended
        assert int(after.time) == (0 if ended else 1)
        np.testing.assert_allclose(seen, look(after, params), atol=1e-6)


def test_ratios_are_to_ours_in_the_same_unit():
    ours = [
        Row(peers.LOOP, "agent steps", 256, 20.0, 20.0, 20.0, 1.0, 100.0),
        Row(peers.ENVIRONMENT, "environment steps", 256, 100.0, 90.0, 110.0, 1.0, 100.0),
    ]
    floor = Row("floor", "environment steps", 1, 4.0, 4.0, 4.0, 0.0, 100.0)
    found = peers.compared([*ours, ROW, floor])
    assert [row["ours_over_it"] for row in found] == [1, 1, 10, 25]


def test_an_environment_is_made_once(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr(environments, "_run", lambda command, seconds: calls.append(command))
    (tmp_path / "some").mkdir()
    python = environments.made(tmp_path, "some", ("one", "two"))
    assert python == (tmp_path / "some" / "bin" / "python").resolve()
    assert [part in calls[1] for part in ("install", "one", "two")] == 3 * [True]
    environments.made(tmp_path, "some", ("one", "two"))
    assert len(calls) == 2
    environments.made(tmp_path, "some", ("one", "three"))
    assert len(calls) == 4


def test_a_peer_that_cannot_be_had_is_skipped_with_a_line(tmp_path, monkeypatch):
    def fail(cache, name, requirements):
        raise environments.UnavailableError("exit 1: no such package")

    monkeypatch.setattr(environments, "made", fail)
    said = []
    rows, skipped = peers.others(tmp_path, peers.PEERS, said.append)
    assert rows == []
    assert set(skipped) == set(peers.PEERS)
    assert said[-1].endswith("skipped, exit 1: no such package")


def test_a_command_that_fails_says_its_last_line():
    wrong = [sys.executable, "-c", "import sys; sys.exit('first\\nlast')"]
    with pytest.raises(environments.UnavailableError, match=r"exit 1: last$"):
        environments._run(wrong, 60)
    with pytest.raises(environments.UnavailableError, match="timed out"):
        environments._run([sys.executable, "-c", "import time; time.sleep(60)"], 0.2)
    with pytest.raises(environments.UnavailableError, match="No such file"):
        environments._run(["/no/such/program"], 60)


def test_rows_come_back_from_another_interpreter(tmp_path, monkeypatch):
    file = tmp_path / "rows.json"
    monkeypatch.setattr("sys.argv", ["peer", str(file)])
    environments.write([ROW])
    text = file.read_text()
    assert json.loads(text)[0]["name"] == "theirs"
    monkeypatch.setattr(environments, "_run", lambda command, seconds: command[-1].write_text(text))
    assert environments.measured(tmp_path / "python", "module") == [ROW]
