import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from encounters import SPEEDS, each_kind, encounters, path, pick, sub_of

from rp_jax.dynamics import Control, angle_of, make_vehicle
from rp_jax.envs import circuit
from rp_jax.hazards import Reach, Window
from rp_jax.recon.labels import exact_threat, label, monte_carlo_threat


@each_kind
def test_whatever_can_be_hit_within_the_horizon_lies_in_the_window(env, kind, x64):
    features, _, hit = encounters(env, kind)
    assert hit.all()  # they do meet
    source = sub_of(env, kind).source
    window = jax.device_get(source.window)
    assert window.contains(features[:, :2]).all()
    reached = jax.jit(jax.vmap(lambda f: source.in_reach(*source.state_of(f))))(features)
    assert reached.all()
    # The window is not so wide that anything would pass: ahead it is nearly reached.
    assert features[:, 0].max() > 0.95 * window.upper[0]
    assert features[:, 1].max() > 0.8 * window.upper[1]
    assert features[:, 1].min() < 0.8 * window.lower[1]


def steepest(turn, steps):
    """Turns that bring a vehicle to a right angle as fast as it can, and no farther."""
    swing = np.minimum(turn * np.arange(1, steps + 1), np.pi / 2)
    return np.diff(swing, prepend=0.0)


@each_kind
@pytest.mark.parametrize("side", ["ahead", "behind", "left", "right"])
def test_the_farthest_meeting_lies_just_inside_the_window(env, kind, side, x64):
    sub = sub_of(env, kind)
    model, source, steps = sub.body, sub.source, sub.source.horizon
    fast, slow = float(model.speeds[-1]), float(model.speeds[0])
    most = float(np.abs(angle_of(model.actions.rotation)).max())
    towards = {"ahead": (1, 0), "behind": (-1, 0), "left": (0, 1), "right": (0, -1)}[side]
    towards = np.asarray(towards, float)
    turns = np.zeros(steps) if towards[0] else towards[1] * steepest(most, steps)
    rotation = jnp.asarray(np.stack([np.cos(turns), np.sin(turns)], axis=-1))
    controls = Control(acceleration=jnp.zeros(steps), rotation=rotation)
    body = make_vehicle((0.0, 0.0), 0.0, slow if side == "behind" else fast)
    last = path(body, controls, model.step)[-1]
    rim = source.radius if kind == "wall" else source.distance
    place = last + (rim - 1e-9) * towards
    if kind == "wall":
        hazard = other = place
    else:  # it comes straight at the agent
        far = place + steps * source.speeds[-1] * towards
        heading = np.arctan2(-towards[1], -towards[0])
        hazard = make_vehicle(far, heading, source.speeds[-1])
        other = hazard.replace(position=place)
    assert source.hits(body.replace(position=last), other)
    relative = source.features(body, hazard)[:2]
    window = source.window
    assert window.contains(relative)
    assert source.in_reach(body, hazard)
    limit = towards @ np.where(towards > 0, window.upper, window.lower)
    np.testing.assert_allclose(towards @ relative, limit, atol=2e-5)


@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("direction", [1, -1])
def test_what_is_in_reach_ahead_depends_on_the_speed_as_worked_out(speed, direction, x64):
    sub = sub_of(circuit, "wall")
    speeds = [speed]
    for _ in range(sub.source.horizon - 1):
        speeds.append(np.clip(speeds[-1] + direction * 0.02, -0.04, 0.1))
    # Where it stands now is a place it comes by; on a straight way those are all between.
    farthest = max(0, *(direction * np.cumsum(speeds))) + 0.1
    body = make_vehicle((0.0, 0.0), 0.0, speed)
    inside, outside = [jnp.asarray([direction * (farthest + d), 0.0]) for d in (-1e-9, 2e-2)]
    assert sub.source.in_reach(body, inside)
    # Turning round costs more than a step's reach here, so nothing else leads there.
    beyond = sub.source.in_reach(body, outside)
    assert not beyond or direction * speed < 0


def test_a_speed_beyond_the_limits_is_believed(x64):
    sub = sub_of(circuit, "wall")
    body = make_vehicle((0.0, 0.0), 0.0, 0.5)  # moves .5, then at most .48, ...
    assert sub.source.in_reach(body, jnp.asarray([2.0, 0.0]))


@each_kind
def test_what_is_out_of_reach_has_no_threat(env, kind):
    sub = sub_of(env, kind)
    key, spread = jax.random.key(3), sub.source.window
    bodies, hazards = jax.vmap(sub.source.sample, (0, None))(jax.random.split(key, 4000), sub.body)
    anywhere = jax.random.uniform(key, (4000, 2), float, spread.lower, spread.upper)
    hazards = anywhere if kind == "wall" else hazards.replace(position=anywhere)
    out = ~jax.jit(jax.vmap(sub.source.in_reach))(bodies, hazards)
    assert 0.1 < out.mean() < 0.95
    estimator = exact_threat if kind == "wall" else functools.partial(monte_carlo_threat, paths=16)
    found = label(key, pick(bodies, out), pick(hazards, out), sub, estimator)
    assert (found.threat == 0).all()


@each_kind
def test_the_window_grows_with_the_horizon(env, kind):
    sub = sub_of(env, kind)
    args = () if kind == "wall" else (sub.source.speeds, sub.source.behaviour)
    windows = [type(sub.source).create(sub.body, *args, horizon=h).window for h in (1, 3, 5, 8)]
    for small, large in itertools.pairwise(windows):
        assert (large.upper > small.upper).all()
        assert (large.lower < small.lower).all()


def test_the_reach_of_the_circuits_vehicle_is_that_worked_out_by_hand():
    reach = Reach.create(circuit.make_params().body, 2)
    lower, upper = reach.box(jnp.asarray(-0.04)).lower, reach.box(jnp.asarray(0.1)).upper
    # Full speed ahead, or reversing, for two steps; the second up to .15 rad to the side.
    np.testing.assert_allclose(upper, [0.2, 0.1 * np.sin(0.15)], atol=1e-6)
    np.testing.assert_allclose(lower, [-0.08, -0.04 * np.sin(0.15)], atol=1e-6)


def test_a_window_contains_its_corners_and_nothing_outside():
    window = Window(lower=jnp.asarray([-1.0, -2.0]), upper=jnp.asarray([3.0, 4.0]))
    inside = jnp.asarray([[-1.0, -2.0], [3.0, 4.0], [0.0, 0.0]])
    outside = jnp.asarray([[-1.1, 0.0], [3.1, 0.0], [0.0, -2.1], [0.0, 4.1]])
    assert window.contains(inside).all()
    assert not window.contains(outside).any()


def test_what_is_nowhere_counts_as_inside_a_window_so_that_it_is_noticed():
    window = Window(lower=jnp.asarray([-1.0, -2.0]), upper=jnp.asarray([3.0, 4.0]))
    assert window.contains(jnp.asarray([[jnp.nan, 0.0], [0.0, jnp.nan]])).all()
