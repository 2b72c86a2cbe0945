"""What tests of several kinds of hazards share: the kinds, and bodies that meet a hazard."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax.dynamics import Vehicle, make_vehicle
from rp_jax.envs import circuit, jam

KINDS = [(circuit, "wall"), (jam, "wall"), (jam, "obstacle")]
NAMES = ["circuit-wall", "jam-wall", "jam-obstacle"]
SPEEDS = [-0.04, 0.0, 0.02, 0.05, 0.1]
each_kind = pytest.mark.parametrize(("env", "kind"), KINDS, ids=NAMES)


@functools.lru_cache
def params_of(env, double):
    assert double == jax.config.jax_enable_x64
    return env.make_params()


def sub_of(env, kind):
    return env.sub_rmdps(params_of(env, jax.config.jax_enable_x64))[kind]


def pick(tree, index):
    return jax.tree.map(lambda table: table[index], tree)


def sequences(rng, rows, steps, choices):
    """Indices (rows, steps) into a table: half the rows repeat one, which leads farthest."""
    free, same = rng.integers(choices, size=(rows, steps)), rng.integers(choices, size=(rows, 1))
    return np.where(rng.random((rows, 1)) < 0.5, same, free)


def directions(rng, rows):
    angle = rng.uniform(-np.pi, np.pi, rows)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def path(start, controls, step):
    """Positions (steps + 1, 2) from `start` under `controls`."""
    end, visited = jax.lax.scan(lambda v, c: (step(v, c), v), start, controls)
    return jnp.concatenate([visited.position, end.position[None]])


@functools.lru_cache
def encounters(env, kind):
    """Bodies anywhere, each with a hazard whose rim it comes to within the horizon.

    Returns their features (20,000, F), the features of the states that have these features, and
    whether the hazard was hit.
    """
    sub, rows, rng = jax.device_get(sub_of(env, kind)), 20_000, np.random.default_rng(0)
    source, model, steps = sub.source, sub.body, sub.source.horizon
    table = jax.tree.map(lambda *a: np.concatenate(a), model.actions, model.baseline.controls)
    controls = pick(table, sequences(rng, rows, steps, len(table.acceleration)))
    place, speed = rng.uniform(-3, 3, (rows, 2)), rng.choice(model.speeds, rows)
    bodies = Vehicle(position=place, heading=directions(rng, rows), speed=speed)
    when, rim = rng.integers(steps + 1, size=rows), directions(rng, rows) * (1 - 1e-9)
    if kind == "wall":
        noise, others = np.zeros((rows, steps)), np.zeros((rows, 2))
    else:
        drives = source.behaviour.controls
        noise = pick(drives, sequences(rng, rows, steps, len(drives.acceleration)))
        fast, start = rng.choice(source.speeds, rows), np.zeros((rows, 2))
        others = Vehicle(position=start, heading=directions(rng, rows), speed=fast)

    def meet(body, controls, when, rim, hazard, noise):
        there = path(body, controls, model.step)[when]
        if kind == "wall":
            hazard = there + source.radius * rim
        else:
            moved = path(hazard, noise, lambda other, c: source.step(other, body, c))[when]
            hazard = hazard.replace(position=there + source.distance * rim - moved)

        def move(carry, now):
            us, other = carry
            after = model.step(us, now[0]), source.step(other, us, now[1])
            return after, source.hits(us, other)

        end, hits = jax.lax.scan(move, (body, hazard), (controls, noise))
        features = source.features(body, hazard)
        again = source.features(*source.state_of(features))
        return features, again, hits.any() | source.hits(*end)

    met = jax.jit(jax.vmap(meet))(bodies, controls, when, rim, others, noise)
    return jax.device_get(met)


def bodies_of(model, places):
    """Bodies (90,) at random poses and speeds about the given places, and an action of each."""
    rng = np.random.default_rng(7)
    where = rng.choice(np.asarray(places), 90)
    speed = rng.uniform(float(model.speeds[0]), float(model.speeds[-1]), 90)
    bodies = make_vehicle(where + rng.uniform(-0.05, 0.05, (90, 2)), rng.uniform(-3, 3, 90), speed)
    return bodies, jnp.arange(90) % 15


def same_bits(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def mirrored_by_hand(vehicle):
    flip = jnp.asarray([1.0, -1.0])
    return vehicle.replace(position=vehicle.position * flip, heading=vehicle.heading * flip)


def drawn(sub, count):
    """(bodies, hazards, features), `count` samples of the source."""
    keys = jax.random.split(jax.random.key(1), count)
    pairs = jax.jit(jax.vmap(sub.source.sample, (0, None)))(keys, sub.body)
    return *pairs, np.asarray(jax.jit(jax.vmap(sub.source.features))(*pairs))


def check_samples(source, bodies, hazards, features, speeds):
    """They lie in reach, in the window, and evenly in the window of their own `speeds`."""
    lower, upper = np.asarray(source.window.lower), np.asarray(source.window.upper)
    assert (features[:, :2] >= lower).all()
    assert (features[:, :2] <= upper).all()
    assert jax.vmap(source.in_reach)(bodies, hazards).all()
    lower, upper = map(np.asarray, jax.tree.leaves(jax.vmap(source.window_at)(*speeds)))
    share = (features[:, :2] - lower) / (upper - lower)
    quartiles = np.quantile(share, [0.25, 0.5, 0.75], axis=0).T
    assert (np.abs(quartiles - [0.25, 0.5, 0.75]) < 0.03).all()


def check_speeds(drawn, reachable):
    """Half of the speeds drawn are reachable from rest, every one of these among them."""
    reachable = np.asarray(reachable)
    assert (drawn >= reachable[0]).all()
    assert (drawn <= reachable[-1]).all()
    on_grid = np.isin(drawn, reachable)
    assert abs(on_grid.mean() - 0.5) < 0.05
    assert np.unique(drawn[on_grid]).size == reachable.size
