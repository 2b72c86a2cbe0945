"""Braking plans and joint walls: exact, and safe for ever."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax import shield
from rp_jax.dynamics import Vehicle, VehicleModel, make_vehicle
from rp_jax.envs import circuit, jam, tracks
from rp_jax.threat.static import (
    MARGIN,
    compress_above_one,
    plan_clearance,
    plan_clearances,
    static_threat,
)


@functools.cache
def made(env):
    return env.make_params(baseline="plans")


def clearances(env, body):
    params = made(env)
    return _clearances(env)(body, params)


@functools.cache
def _clearances(env):
    def each(body, params):
        room = lambda position: env.clearance(position, params)  # noqa: E731
        return plan_clearance(body, params.body, room)

    return jax.jit(each)


def walls_of(env):
    return np.asarray(made(env).track.walls) if env is circuit else jam.wall_points()


@pytest.mark.parametrize("env", [circuit, jam])
def test_clearance_never_exceeds_the_room_and_comes_close(env):
    params, walls = made(env), walls_of(env)
    rng = np.random.default_rng(0)
    near = walls[rng.integers(len(walls), size=3000)]
    places = (near + rng.uniform(-0.3, 0.3, near.shape)).astype(np.float32)
    true = np.sqrt(((places[:, None] - walls[None]) ** 2).sum(-1).min(1)) - 0.1
    found = np.asarray(jax.vmap(env.clearance, (0, None))(jnp.asarray(places), params))
    relevant = true > -0.01
    assert (found[relevant] <= true[relevant] + 1e-6).all()
    assert (found[relevant] >= true[relevant] - 0.011).all()
    assert np.abs(found[relevant] - true[relevant]).mean() < 1e-3


class Heavy(VehicleModel):
    """A vehicle that slides by a tenth of a turn's side, unlike those whose paths are moved."""

    def step(self, vehicle, control):
        moved = super().step(vehicle, control)
        return moved.replace(position=moved.position + 0.01 * moved.heading[::-1])


@pytest.mark.parametrize(
    ("env", "kind"),
    [(jam, "vehicle"), (circuit, "vehicle"), (jam, "kept in a room"), (jam, "of its own")],
)
def test_many_bodies_at_once_have_the_clearances_of_each_alone(env, kind):
    params, rng = made(env), np.random.default_rng(1)
    model, rows = params.body, 40
    if kind == "kept in a room":
        model = model.replace(room=jnp.asarray(0.5))
    if kind == "of its own":
        model = Heavy(model.actions, model.baseline, model.speeds)
    speeds = rng.choice(np.asarray(model.speeds), rows).astype(np.float32)
    speeds[3::4] = rng.uniform(model.speeds[0], model.speeds[-1], rows // 4)  # others, too
    places = rng.uniform(0.3, 1.0, (rows, 2))
    bodies = make_vehicle(places, rng.uniform(-np.pi, np.pi, rows), speeds)
    room = lambda position: env.clearance(position, params)  # noqa: E731
    found = jax.jit(lambda b: plan_clearances(b, model, room))(bodies)
    each = jax.jit(jax.vmap(lambda b: plan_clearance(b, model, room)))(bodies)
    assert found.shape == each.shape == (rows, len(model.baseline.target), 15)
    np.testing.assert_allclose(found, each, rtol=0, atol=2e-6)
    np.testing.assert_array_equal(static_threat(found) > 0, static_threat(each) > 0)


def test_a_body_that_is_nowhere_has_no_clearance():
    env, params = jam, made(jam)
    body = make_vehicle(jnp.full((2, 2), jnp.nan), jnp.zeros(2), jnp.zeros(2))
    room = lambda position: env.clearance(position, params)  # noqa: E731
    assert np.isnan(plan_clearances(body, params.body, room)).all()


@pytest.mark.parametrize("env", [circuit, jam])
def test_ways_of_plans_are_those_of_a_slow_loop(env):
    params = made(env)
    model, plans = params.body, params.body.baseline
    start = make_vehicle((0.7, 0.9) if env is jam else (0.5, 0.02), 0.7, 0.06)
    found = np.asarray(clearances(env, start))
    assert found.shape == (len(plans.target), 15)
    for k in range(len(plans.target)):
        plan = plans.replace(**{n: getattr(plans, n)[k] for n in ("rotation", "target", "steps")})
        for a in (0, 7, 14):
            us = model.step(start, jax.tree.map(lambda t, a=a: t[a], model.actions))
            room = [float(env.clearance(us.position, params))]
            for j in range(plans.horizon - 1):
                us = model.step(us, plan.control(j, us.speed))
                room.append(float(env.clearance(us.position, params)))
            assert abs(float(us.speed)) < 1e-6  # it stands still
            assert found[k, a] == pytest.approx(min(room), abs=1e-5)


def test_threats_of_walls_are_none_or_certain_and_graded():
    room = jnp.asarray([0.3, MARGIN, MARGIN / 2, 0.0, -0.02, -0.09])
    threat = np.asarray(static_threat(room))
    np.testing.assert_array_equal(threat[:2], 0)
    assert (threat[2:] >= 2).all()
    assert (threat <= 3).all()
    assert (np.diff(threat[1:]) > 0).all()
    assert not static_threat(jnp.asarray(jnp.nan)) <= 1  # and so never admissible


def test_sums_above_one_keep_their_order_below_a_wall_s_threat():
    total = jnp.asarray([0.0, 0.3, 1.0, 1.2, 3.0, 100.0])
    found = np.asarray(compress_above_one(total))
    np.testing.assert_array_equal(found[:3], total[:3])
    assert (np.diff(found) > 0).all()
    assert found.max() < 1.5


TRACKS = {
    "default": "default",
    "narrowed": "narrowed",
    "tight": tracks.TrackPlan(half_width=0.18)
    .straight(1.5)
    .curve(0.6, 180)
    .straight(1.5)
    .curve(0.6, 180),
}


@pytest.mark.parametrize("track", TRACKS)
def test_who_starts_secure_stays_secure_whatever_it_does(track):
    """Random admissible actions, 200 steps: never a wall, never a state without a way out."""
    params = circuit.make_params(TRACKS[track], baseline="plans")
    rows, steps = 64, 200

    def act(states, t):
        room = lambda position: circuit.clearance(position, params)  # noqa: E731
        clear = jax.vmap(lambda body: plan_clearance(body, params.body, room))(states.body)
        threat = jnp.min(static_threat(clear), axis=1)
        allowed = jax.vmap(shield.shield, (0, None))(threat, 0.5)
        keys = jax.random.split(jax.random.fold_in(jax.random.key(1), t), rows)
        # Fast ones first: half of the time the admissible action of the greatest acceleration.
        wild = jax.vmap(shield.masked_sample)(keys, allowed.admissible)
        fast = jax.vmap(shield.masked_argmax, (None, 0))(
            params.body.actions.acceleration, allowed.admissible
        )
        action = jnp.where(jnp.arange(rows) % 2 == 0, wild, fast)
        states, outcome = jax.vmap(circuit.step, (0, 0, 0, None))(keys, states, action, params)
        return states, (outcome.danger, allowed.secure, states.body.speed)

    start = jax.vmap(circuit.reset, (0, None))(jax.random.split(jax.random.key(0), rows), params)
    _, (danger, secure, speed) = jax.jit(lambda s: jax.lax.scan(act, s, jnp.arange(steps)))(start)
    assert float(danger.sum()) == 0
    assert bool(secure.all())
    assert float(jnp.abs(speed).max()) == pytest.approx(0.1, abs=1e-6)
    assert float((jnp.abs(speed) > 0.05).mean()) > 0.2


@pytest.mark.parametrize("env", [circuit, jam])
def test_under_plans_walls_are_no_hazards_of_their_own(env):
    params = made(env)
    state = env.reset(jax.random.key(0), params)
    assert "wall" not in env.hazards(state, params)
    assert "wall" not in env.sub_rmdps(params)
    assert "wall" in env.collisions(state, params)
    assert isinstance(state.body, Vehicle)
