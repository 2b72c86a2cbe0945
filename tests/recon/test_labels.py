import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from rp_jax.dynamics import VehicleModel, advance, independent_controls, make_vehicle, num_threats
from rp_jax.envs import circuit, jam, point_gather
from rp_jax.hazards import SubRMDP
from rp_jax.recon.labels import (
    Labels,
    best_estimator,
    exact_threat,
    label,
    leaves,
    monte_carlo_threat,
    plan_threat,
)

WALLS = [(circuit, "threat_truth_circuit_wall"), (jam, "threat_truth_jam_wall")]
PATHS = 4096  # of the fixture `monte_carlo`
STILL = 7  # the action of neither acceleration nor turn


enumerate_all = jax.jit(exact_threat)
enumerate_each = jax.jit(jax.vmap(exact_threat, (None, 0, 0, None)))
simulate = jax.jit(monte_carlo_threat, static_argnames="paths")


@functools.lru_cache
def subs_of(env, double):
    assert double == jax.config.jax_enable_x64
    return env.sub_rmdps(env.make_params())


def sub_of(env, kind):
    return subs_of(env, jax.config.jax_enable_x64)[kind]


def with_source(sub, **changes):
    return sub.replace(source=sub.source.replace(**changes))


def of_cars(states):
    """Features of states (x, y, relative heading, its speed, the agent's speed)."""
    x, y, turn, *speeds = states.T
    return jnp.asarray(np.stack([x, y, np.cos(turn), np.sin(turn), *speeds], axis=-1), float)


@pytest.mark.parametrize(("env", "name"), WALLS)
def test_enumerated_threats_of_walls_are_the_recorded_ones(env, name, golden, exact, precision):
    data = golden(name)
    found = exact(jnp.asarray(data["states"], float), sub_of(env, "wall"))
    tolerance = {"float64": 1e-6, "float32": 1e-5}[precision]
    assert found.threat.dtype == precision
    np.testing.assert_allclose(found.threat, data["truth"], rtol=0, atol=tolerance)
    assert (np.asarray(found.stderr) == 0).all()


@pytest.mark.parametrize(("env", "name"), WALLS)
def test_simulated_threats_of_walls_agree_with_the_enumerated_ones(env, name, golden, monte_carlo):
    data = golden(name)
    states, truth = data["states"][:150], data["truth"][:150]
    features = jnp.asarray(states, float)
    found = monte_carlo(jax.random.key(1), features, sub_of(env, "wall"))
    error = np.sqrt(truth * (1 - truth) / PATHS + PATHS**-2.0)
    assert ((truth > 0.01) & (truth < 0.99)).sum() > 150
    assert np.abs((found.threat - truth) / error).max() < 4.5


@pytest.fixture(scope="module")
def cars(golden, monte_carlo):
    """Simulated labels of the recorded obstacles, their recorded threats and standard errors."""
    data = golden("threat_truth_jam_car")
    join = lambda name: np.concatenate([data[name], data[f"{name}_near"]])  # noqa: E731
    features = of_cars(join("states"))
    assert features.shape == (150, 6)
    found = monte_carlo(jax.random.key(2), features, sub_of(jam, "obstacle"))
    return found, join("truth"), join("stderr")


def test_simulated_threats_of_obstacles_agree_with_the_recorded_ones(cars):
    found, truth, spread = cars
    error = np.sqrt(truth * (1 - truth) / PATHS + spread**2 + PATHS**-2.0)
    z = (np.asarray(found.threat, np.float64) - truth) / error
    assert z.shape == (150, 15)
    assert np.abs(z).max() < 4
    # Neither biased, nor nearer than chance allows.
    undecided = (truth > 0.01) & (truth < 0.99)
    assert undecided.sum() > 200
    assert abs(z[undecided].mean()) < 0.3
    assert 0.8 < z[undecided].std() < 1.2


def test_the_reported_error_is_that_of_the_estimate(cars):
    found, truth, _ = cars
    undecided = (truth > 0.05) & (truth < 0.95)
    assert undecided.sum() > 100
    expected = np.sqrt(truth * (1 - truth) / PATHS)
    np.testing.assert_allclose(found.stderr[undecided], expected[undecided], rtol=0.15)


class Driver(VehicleModel):
    """A vehicle of which the enumeration is not told that its controls act one step later."""

    def step(self, vehicle, control):
        return advance(vehicle, control, self.speeds)


def test_skipping_the_last_control_of_a_delayed_agent_changes_nothing():
    sub = with_source(sub_of(jam, "wall"), horizon=3)
    rng = np.random.default_rng(0)
    states = rng.uniform([-0.2, -0.25, -0.1], [0.4, 0.25, 0.1], (300, 3))
    bodies, points = jax.vmap(sub.source.state_of)(jnp.asarray(states, float))
    key = jax.random.key(0)
    short = enumerate_each(key, bodies, points, sub).threat
    model = Driver(sub.body.actions, sub.body.baseline, sub.body.speeds, delayed=False)
    long = enumerate_each(key, bodies, points, sub.replace(body=model)).threat
    assert ((long > 0.01) & (long < 0.99)).sum() > 100
    np.testing.assert_allclose(short, long, atol=1e-6)


def wall_within(steps, beta=0.999):
    return with_source(sub_of(jam, "wall"), horizon=steps).replace(beta=jnp.asarray(beta))


def threats_of(x, speed, beta=0.999):
    """Of a wall point straight ahead, within three steps: enumerated, and simulated."""
    body, wall = make_vehicle((0.0, 0.0), 0.0, speed), jnp.asarray([x, 0.0])
    sub = wall_within(3, beta)
    key = jax.random.key(0)
    return enumerate_all(key, body, wall, sub), simulate(key, body, wall, sub, paths=8)


def test_what_is_hit_already_threatens_every_action_by_one():
    for found in threats_of(0.05, 0.1):
        np.testing.assert_array_equal(found.threat, np.ones(15))
    body, _, sub = uncertain()
    other = make_vehicle((0.1, 0.1), 0.0, 0.06)
    found = simulate(jax.random.key(0), body, other, sub, paths=200)
    np.testing.assert_array_equal(found.threat, np.ones(15))


@pytest.mark.parametrize("beta", [0.5, 0.999, 1.0])
def test_the_threat_of_a_certain_hit_is_beta_to_the_power_of_its_step(beta):
    for ahead, steps in ((0.15, 1), (0.25, 2)):
        for found in threats_of(ahead, 0.1, beta):
            np.testing.assert_allclose(found.threat[STILL], beta**steps, rtol=1e-6)
            np.testing.assert_allclose(found.stderr[STILL], 0.0, atol=1e-7)


def test_the_first_move_is_the_same_whatever_the_action():
    # The vehicle moves by its old speed, so a wall hit at step 1 is hit under all actions.
    for found in threats_of(0.15, 0.1):
        np.testing.assert_allclose(found.threat, np.full(15, 0.999), rtol=1e-6)


def test_braking_at_once_delays_a_hit_by_a_step():
    exact, _ = threats_of(0.285, 0.1)
    # Two steps lead .18 ahead after braking, .2 after not; the third leads past .185.
    expected = [0.999**3, 0.999**2, 0.999**2]
    np.testing.assert_allclose(exact.threat[jnp.asarray([2, 7, 12])], expected, rtol=1e-6)


def test_the_probabilities_of_the_baseline_weigh_the_branches():
    # From rest, action 12 drives .02 at step 2; .06 in all at step 3 only if the baseline
    # accelerates again, and that has probability .2. No other action gets past .055.
    exact, _ = threats_of(0.155, 0.0, beta=1.0)
    np.testing.assert_allclose(exact.threat[12], 0.2, rtol=1e-6)
    np.testing.assert_allclose(exact.threat[:10], np.zeros(10), atol=1e-7)


def test_beta_weighs_later_hits_less(exact, golden):
    data = golden("threat_truth_jam_wall")
    features = jnp.asarray(data["states"], float)
    sub = sub_of(jam, "wall")
    found = [
        np.asarray(exact(features, sub.replace(beta=jnp.asarray(beta))).threat, np.float64)
        for beta in (0.5, 0.9, 1.0)
    ]
    # As E[beta^K], it lies between beta^5 and beta times the chance of a hit from step 1 on.
    later = found[2] * (found[0] < 1)
    for beta, threat in zip((0.5, 0.9), found, strict=False):
        assert (threat[found[0] < 1] <= beta * later[found[0] < 1] + 1e-6).all()
        assert (threat >= beta**5 * later - 1e-6).all()
    assert found[2].max() <= 1 + 1e-6


@pytest.mark.parametrize(("env", "kind"), [(circuit, "wall"), (jam, "wall"), (jam, "obstacle")])
def test_outside_the_window_there_is_no_threat(env, kind, exact, monte_carlo):
    sub = sub_of(env, kind)
    low = np.asarray(sub.source.window.lower, float) - 1e-3
    high = np.asarray(sub.source.window.upper, float) + 1e-3
    rows = 250 if kind == "wall" else 150
    rng = np.random.default_rng(0)
    where = rng.uniform(low, high, (rows, 2))
    side = rng.integers(2, size=rows)  # this coordinate is put on the rim
    where[np.arange(rows), side] = np.where(rng.random(rows) < 0.5, low[side], high[side])
    speed = rng.choice(np.asarray(sub.body.speeds)[[0, -1]], (rows, 1))
    if kind == "wall":
        found = exact(jnp.asarray(np.hstack([where, speed]), float), sub)
    else:
        home = -where / np.linalg.norm(where, axis=-1, keepdims=True)  # they drive at the agent
        features = np.hstack([where, home, np.full((rows, 1), 0.06), speed])
        found = monte_carlo(jax.random.key(0), jnp.asarray(features, float), sub)
    assert (np.asarray(found.threat) == 0).all()


def uncertain():
    """An obstacle ahead that a vehicle may or may not hit within four steps."""
    body, other = make_vehicle((0.0, 0.0), 0.0, 0.06), make_vehicle((0.6, 0.0), 3.0, 0.06)
    return body, other, with_source(sub_of(jam, "obstacle"), horizon=4)


def test_the_standard_error_shrinks_with_the_root_of_the_paths():
    few, many = (simulate(jax.random.key(0), *uncertain(), paths=n) for n in (200, 5000))
    undecided = np.asarray((many.threat > 0.1) & (many.threat < 0.9))
    assert undecided.sum() > 3
    np.testing.assert_allclose((few.stderr / many.stderr)[undecided], 5.0, rtol=0.3)


def test_simulated_threats_are_a_function_of_the_key():
    first, again, other = (
        simulate(jax.random.key(k), *uncertain(), paths=200).threat for k in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert (np.asarray(first) != np.asarray(other)).any()


def test_one_path_claims_no_precision():
    found = simulate(jax.random.key(0), *uncertain(), paths=1)
    np.testing.assert_array_equal(found.stderr, np.ones(15))


def test_hazards_that_stay_put_are_enumerated_and_others_simulated():
    assert best_estimator(sub_of(jam, "wall"), 64) is exact_threat
    assert best_estimator(sub_of(jam, "wall"), 64, exact=False).func is monte_carlo_threat
    body, other, sub = uncertain()
    found = jax.jit(best_estimator(sub, 200))(jax.random.key(0), body, other, sub)
    expected = simulate(jax.random.key(0), body, other, sub, paths=200)
    np.testing.assert_array_equal(found.threat, expected.threat)


def test_labelling_in_calls_gives_every_row_its_own_label():
    sub = with_source(sub_of(jam, "wall"), horizon=3)
    rng = np.random.default_rng(0)
    states = rng.uniform([-0.2, -0.25, -0.1], [0.4, 0.25, 0.1], (300, 3))
    bodies, points = jax.vmap(sub.source.state_of)(jnp.asarray(states, float))
    calls = []
    found = label(
        jax.random.key(0),
        bodies,
        points,
        sub,
        exact_threat,
        batch=8,
        rows=128,
        on_progress=lambda done, total: calls.append((done, total)),
    )
    expected = enumerate_each(jax.random.key(0), bodies, points, sub)
    assert calls == [(128, 300), (256, 300), (300, 300)]
    np.testing.assert_allclose(found.threat, expected.threat, atol=1e-6)
    assert found.stderr.shape == (300, 15)


def test_every_row_is_labelled_with_a_key_of_its_own():
    def noise(key, body, hazard, sub):
        return Labels(threat=jax.random.uniform(key, (3,)), stderr=jnp.zeros(3))

    bodies, points = make_vehicle(np.zeros((40, 2)), np.zeros(40), np.zeros(40)), jnp.zeros((40, 2))
    found = label(jax.random.key(0), bodies, points, sub_of(jam, "wall"), noise, rows=16).threat
    assert found.shape == (40, 3)
    assert np.unique(np.asarray(found)).size == 120


def test_threats_of_plans_are_those_of_a_slow_loop():
    """A still obstacle ahead: each plan either meets it at a step, or does not."""
    sub = jam.sub_rmdps(jam.make_params(1, baseline="plans"))["obstacle"]
    still = sub.source.replace(behaviour=independent_controls([0.0], [1.0], [0.0], [1.0]))
    sub = sub.replace(source=still)
    us, other = make_vehicle((0.0, 0.0), 0.0, 0.08), make_vehicle((0.42, 0.05), 0.0, 0.0)
    found = plan_threat(jax.random.key(0), us, other, sub, 2)
    plans, model = sub.body.baseline, sub.body
    assert found.threat.shape == (135,)
    np.testing.assert_allclose(found.stderr, 0, atol=1e-6)
    for k in range(9):
        plan = plans.replace(**{n: getattr(plans, n)[k] for n in ("rotation", "target", "steps")})
        for a in range(15):
            vehicle, expected = us, 0.0
            for j in range(sub.source.horizon):
                first = jax.tree.map(lambda t, a=a: t[a], model.actions)
                control = first if j == 0 else plan.control(j - 1, vehicle.speed)
                vehicle = model.step(vehicle, control)
                if bool(sub.source.hits(vehicle, other)):
                    expected = float(sub.beta) ** (j + 1)
                    break
            assert found.threat[15 * k + a] == pytest.approx(expected, abs=1e-6)
    assert 0 < float((np.asarray(found.threat) > 0).mean()) < 1


def test_plans_are_labelled_by_rollouts_of_plans():
    sub = jam.sub_rmdps(jam.make_params(1, baseline="plans"))["obstacle"]
    chosen = best_estimator(sub, 7)
    assert chosen.func is plan_threat
    assert chosen is best_estimator(sub, 7)


def test_trees_are_enumerated_where_they_are_small_enough():
    assert leaves(sub_of(circuit, "wall")) == 15 * 9**3
    subs = {
        h: point_gather.sub_rmdps(point_gather.make_params(horizon=h))["bomb"] for h in (1, 2, 15)
    }
    assert [leaves(subs[h]) for h in (1, 2)] == [81, 81**2]
    assert best_estimator(subs[2], 10) is exact_threat
    assert best_estimator(subs[15], 10).func is monte_carlo_threat


def test_sampled_threats_of_a_bomb_agree_with_enumerated_ones():
    sub = point_gather.sub_rmdps(point_gather.make_params(horizon=2))["bomb"]
    body, bomb = make_vehicle((5.0, 0.0), 0.3, 0.0), jnp.asarray([5.5, 1.6])
    true = enumerate_all(jax.random.key(0), body, bomb, sub).threat
    found = simulate(jax.random.key(1), body, bomb, sub, paths=2000)
    assert ((true > 0.05) & (true < 0.9)).any()
    assert (np.abs(found.threat - true) <= 5 * found.stderr + 1e-3).all()


@pytest.mark.parametrize("kind", ["wall", "obstacle"])
def test_simulated_threats_are_those_of_a_slow_loop(kind):
    """Path by path: the baseline's controls come from the first key, the hazard from the second."""
    paths, horizon, key = 5, 4, jax.random.key(4)
    body, other, sub = uncertain()
    if kind == "wall":
        other, sub = jnp.asarray([0.3, 0.05]), with_source(sub_of(jam, kind), horizon=horizon)
    model, source = sub.body, sub.source
    found = simulate(key, body, other, sub, paths=paths)
    ours, theirs = jax.random.split(key)
    controls = model.baseline.draw(ours, (horizon - 1, paths))
    noise = source.draw(theirs, (horizon, paths))
    hits = np.zeros((paths, 15))

    @jax.jit
    def step(us, hazard, control, random):
        hazard, us = source.step(hazard, us, random), model.step(us, control)
        return us, hazard, source.hits(us, hazard)

    for path, action in np.ndindex(hits.shape):
        us, hazard = body, other
        for k in range(horizon):
            table, row = (model.actions, action) if k == 0 else (controls, (k - 1, path))
            control, random = (
                jax.tree.map(lambda a, i=i: a[i], tree)
                for tree, i in ((table, row), (noise, (k, path)))
            )
            us, hazard, hit = step(us, hazard, control, random)
            if hit:
                hits[path, action] = float(sub.beta) ** (k + 1)
                break
    assert 0 < (hits > 0).mean() < 1
    np.testing.assert_allclose(found.threat, hits.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(
        found.stderr, hits.std(axis=0, ddof=1) / np.sqrt(paths), rtol=1e-4, atol=1e-7
    )


class Cart(struct.PyTreeNode):
    """A body on a line that goes on at its speed; `body` is (place, speed)."""

    actions: jax.Array  # (3,) changes of speed
    baseline: object

    def control(self, action):
        return self.actions[action]

    def step(self, body, control):
        place, speed = body
        return place + speed, speed + control


class Brakes(struct.PyTreeNode):
    """Brakes by 1 at most until it stands still; at each step it coasts instead now and then."""

    coasting: float = 0.0  # probability

    def draw(self, key, shape=()):
        return jax.random.bernoulli(key, self.coasting, shape)

    def act(self, body, noise):
        return jnp.where(noise, 0.0, -jnp.clip(body[1], -1.0, 1.0))


class Post(struct.PyTreeNode):
    """Stays at a place of the line; hit within .5."""

    horizon: int = struct.field(pytree_node=False, default=6)
    static: bool = struct.field(pytree_node=False, default=True)

    def draw(self, key, shape=()):
        return jnp.zeros(shape)

    def step(self, hazard, body, noise):
        return hazard

    def hits(self, body, hazard):
        return jnp.abs(body[0] - hazard) < 0.5


SLOWER, SAME, FASTER = range(3)


def carts(baseline, place, horizon=6, paths=3):
    """Threats, beta = .5, of a cart at 0 and of speed 2 to a post at `place`."""
    model = Cart(jnp.asarray([-1.0, 0.0, 1.0]), baseline)
    sub = SubRMDP(model, Post(horizon=horizon), beta=jnp.asarray(0.5))
    assert num_threats(model) == 3
    chosen = best_estimator(sub, paths)
    assert chosen.func is monte_carlo_threat  # what heeds the body is not enumerated
    return chosen(jax.random.key(0), (jnp.zeros(()), jnp.asarray(2.0)), jnp.asarray(place), sub)


# Braking after the first action, the cart comes by 2, 3 and stays; by 2, 4, 5; by 2, 5, 7, 8.
@pytest.mark.parametrize(
    ("place", "steps"),
    [
        (0.0, (0, 0, 0)),
        (2.0, (1, 1, 1)),
        (3.0, (2, None, None)),
        (4.0, (None, 2, None)),
        (5.0, (None, 3, 2)),
        (7.0, (None, None, 3)),
        (8.0, (None, None, 4)),
        (9.0, (None, None, None)),
        (-3.0, (None, None, None)),
    ],
)
def test_a_baseline_may_brake_by_the_speed_of_the_body(place, steps):
    found = carts(Brakes(), place)
    expected = [0.0 if step is None else 0.5**step for step in steps]
    np.testing.assert_array_equal(found.threat, expected)
    np.testing.assert_array_equal(found.stderr, 0)
    if place == 8.0:
        np.testing.assert_array_equal(carts(Brakes(), place, horizon=3).threat, 0)


def test_a_baseline_that_sees_nothing_would_not_stop():
    class Blind(Brakes):
        def act(self, body, noise):
            return jnp.asarray(-1.0)

    # By 2, 3, 3, 2, 0, -3; by 2, 4, 5, 5, 4, 2; by 2, 5, 7, 8, 8, 7.
    np.testing.assert_array_equal(carts(Blind(), -3.0).threat, [0.5**6, 0, 0])
    np.testing.assert_array_equal(carts(Brakes(), -3.0).threat, [0, 0, 0])


def test_a_baseline_s_own_randomness_is_drawn_for_every_step_and_path():
    """A post at 6: coasting once at step 2 hits it at step 3, coasting then only, at step 4."""
    paths, coasting = 4000, 0.75
    found = carts(Brakes(coasting), 6.0, horizon=4, paths=paths)
    expected = coasting * 0.5**3 + (1 - coasting) * coasting * 0.5**4
    # The faster cart comes by 2, 5 and then 8, or 7: nothing is hit; the slower one by 2, 3 and 4,
    # or 3, and 5 at most.
    np.testing.assert_array_equal(found.threat[jnp.asarray([SLOWER, FASTER])], [0, 0])
    second = coasting * 0.5**6 + (1 - coasting) * coasting * 0.5**8
    spread = np.sqrt(second - expected**2)
    np.testing.assert_allclose(found.stderr[SAME], spread / np.sqrt(paths), rtol=0.05)
    assert abs(found.threat[SAME] - expected) < 4 * found.stderr[SAME]


def test_the_paths_of_all_actions_share_the_baseline_s_draws():
    """The slower and the same: whoever coasts at step 2 is one cell farther on, in both."""
    found = [carts(Brakes(0.5), place, horizon=3, paths=400).threat for place in (4.0, 6.0)]
    assert 0 < found[0][SLOWER] == found[1][SAME] < 0.5**3
