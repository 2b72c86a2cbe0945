"""Calls of the API with anything for an argument: a ValueError that names it, or a good result.

RP_FUZZ sets the number of examples of the slow part.
"""

import dataclasses
import os
import re

import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from quick import compile_soon  # noqa: F401

from rp_jax import evaluation, shield
from rp_jax.envs import circuit, jam, point_gather, tracks
from rp_jax.envs.tracks import TrackPlan
from rp_jax.planning import dqn, loop
from rp_jax.recon import labels
from rp_jax.runs import train
from rp_jax.runs.train import Process, TrainConfig, World
from rp_jax.threat import build, fit

MANY = int(os.environ.get("RP_FUZZ", "1000"))
MOST = 2**31  # bytes that the process may grow by, whatever sizes it was told

ODD = [None, True, "", "paper", "plans", [], [1, 2], (), (5,), {}, b"x", 1j, object(), {1, 2}]
ODD += [float("nan"), float("inf"), -float("inf"), 1e300, -1e300, 5e-324, 10**30, -(10**30), -1, 0]
ODD += [np.zeros(0), np.ones((2, 2)), np.asarray("a"), np.float32(0.1), np.int64(3)]
junk = st.one_of(
    st.sampled_from(ODD),
    st.integers(),
    st.integers(0, 40),
    st.floats(),
    st.floats(0, 1),
    st.text(max_size=4),
)
some = settings(max_examples=50)
many = settings(max_examples=MANY)


@pytest.fixture(autouse=True, scope="module")
def nothing_large_is_allocated():
    resource = pytest.importorskip("resource")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert 1024 * (after - before) < MOST


def named(fields, call):
    """It is a good call, or a ValueError names a field and what is allowed."""
    try:
        call()
    except ValueError as error:
        said = str(error)
    else:
        return
    assert said.startswith(tuple(fields)), said
    assert re.search("must|misses the start|crosses itself|does not lead home", said), said


CONFIGS = {
    "fit": fit.FitConfig(),
    "threat": build.ThreatConfig(),
    "learner": dqn.DQNConfig(),
    "loop": loop.LoopConfig(),
}
PLAIN = {
    name: [f.name for f in dataclasses.fields(config) if f.name not in ("fit", "learner")]
    for name, config in CONFIGS.items()
}
changed = st.sampled_from(sorted(CONFIGS)).flatmap(
    lambda name: st.tuples(
        st.just(name), st.dictionaries(st.sampled_from(PLAIN[name]), junk, min_size=1, max_size=3)
    )
)


def validated(name, changes):
    config = dataclasses.replace(CONFIGS[name], **changes)
    relied = {"replay", "replay_start", "steps", "fit.validation"}  # on the others
    named([f"{name}.{field}" for field in {*changes, *relied}], lambda: config.validate(name))


def run_validated(changes):
    named(changes, dataclasses.replace(TrainConfig(), **changes).validate)


CORRIDOR = World("corridor", probe, {}, {"as learned": {}})


def checked(devices):
    process = Process(devices=devices)
    named(["devices"], lambda: train.checked(CORRIDOR, TrainConfig(), {}, process))


RUN = "seeds seed x lookahead learning_penalty learning_penalty_from insecure_penalty penalty "
RUN += "episodes c refunds"
of_runs = st.dictionaries(st.sampled_from(RUN.split()), junk, min_size=1, max_size=3)


class TestConfigurations:
    @given(changed)
    @some
    def test_some(self, change):
        validated(*change)

    @pytest.mark.slow
    @given(changed)
    @many
    def test_many(self, change):
        validated(*change)

    @given(of_runs)
    @some
    def test_some_of_runs(self, changes):
        run_validated(changes)

    @pytest.mark.slow
    @given(of_runs)
    @many
    def test_many_of_runs(self, changes):
        run_validated(changes)

    @given(junk)
    @some
    def test_some_devices(self, devices):
        checked(devices)


ENVS = {
    circuit: "track time_limit radius horizon beta fidelity baseline",
    jam: "num_obstacles time_limit radius beta fewest wall_horizon obstacle_horizon fidelity "
    "baseline",
    point_gather: "num_apples num_bombs time_limit horizon beta fidelity",
}
arguments = st.sampled_from(sorted(ENVS, key=lambda env: env.__name__)).flatmap(
    lambda env: st.tuples(
        st.just(env),
        st.dictionaries(st.sampled_from(ENVS[env].split()), junk, min_size=1, max_size=3),
    )
)


def parameters(env, given):
    named({*given, "track: half_width", "track: at centre point"}, lambda: env.make_params(**given))


class TestParameters:
    @given(arguments)
    @some
    def test_some(self, call):
        parameters(*call)

    @pytest.mark.slow
    @given(arguments)
    @many
    def test_many(self, call):
        parameters(*call)


numbers = st.one_of(junk, st.floats(0.1, 3), st.integers(-360, 360))
pieces = st.one_of(
    st.tuples(st.just("straight"), numbers),
    st.tuples(st.just("curve"), numbers, numbers),
    st.tuples(st.just("close"), numbers),
    st.tuples(st.just("widened"), numbers),
)
raw = st.fixed_dictionaries(
    {},
    optional={
        "half_width": junk,
        "points": st.one_of(junk, st.just(tracks.circle_plan().points)),
        "angles": st.one_of(junk, st.just(tracks.circle_plan().angles)),
        "position": junk,
        "angle": junk,
    },
)


def drawn(pieces, end):
    def call():
        plan = TrackPlan().straight(2.0).curve(1.0, 180)
        for name, *values in pieces:
            plan = getattr(plan, name)(*values)
        plan = plan.straight(2.0).curve(1.0, 180) if end else plan
        return tracks.make_track(plan, 0.1, 0.1, 0.7)

    named(("straight: ", "curve: ", "close: ", "track: "), call)


def made(fields):
    plan = dataclasses.replace(tracks.circle_plan(), **fields)
    named(("track: ",), lambda: tracks.make_track(plan, 0.1, 0.1, 0.7))


class TestTracks:
    @given(st.lists(pieces, max_size=3), st.booleans())
    @some
    def test_some(self, pieces, end):
        drawn(pieces, end)

    @pytest.mark.slow
    @given(st.lists(pieces, max_size=3), st.booleans())
    @many
    def test_many(self, pieces, end):
        drawn(pieces, end)

    @given(raw)
    @some
    def test_some_plans_that_were_not_drawn(self, fields):
        made(fields)

    @pytest.mark.slow
    @given(raw)
    @many
    def test_many_plans_that_were_not_drawn(self, fields):
        made(fields)


KEY = jax.random.key(0)
PARAMS = probe.make_params()
PMDP = probe.make_pmdp(probe, PARAMS)
SUB = probe.sub_rmdps(PARAMS)["pit"]
BODIES = jax.tree.map(lambda a: jnp.stack([a] * 4), probe.start_at(3).body)
HAZARDS = jnp.zeros((4, 2))
FEW = jax.tree.map(lambda a: a[:3], BODIES)
NONE = jax.tree.map(lambda a: a[:0], BODIES)
DATA = fit.Dataset(jnp.ones((40, 3)), jnp.ones((40, 3)))
NO_KEYS = [None, 0, "key", jax.random.split(KEY, 2), jax.random.key_data(KEY), np.zeros(2)]
NO_COUNTS = [0, -3, 2.0, 10**12, True, None, "7", float("nan"), np.ones(2), 3 + 0j]
THREE = jnp.asarray([0.1, 0.2, 0.9])
NO_ROWS = [None, 0.5, "abc", [0.1, 0.2], jnp.zeros(()), jnp.zeros((2, 3)), np.asarray(["a"])]


def zeros(percept):
    return jnp.zeros(percept.admissible.shape)


def label(key=KEY, body=BODIES, hazard=HAZARDS, **sizes):
    return labels.label(key, body, hazard, SUB, labels.exact_threat, **sizes)


def play(key=KEY, values=zeros, episodes=8, **sizes):
    return evaluation.run_episodes(key, PMDP, values, episodes, **sizes)


def learn(key=KEY, **changes):
    return loop.init(key, PMDP, dataclasses.replace(loop.LoopConfig(), **changes))


def fitted(key=KEY, data=DATA, **changes):
    return build.fitted(key, SUB, data, dataclasses.replace(fit.FitConfig(), **changes))


def built(key=KEY, x=0.5, **changes):
    return build.learn_threat(key, SUB, dataclasses.replace(build.ThreatConfig(), **changes), x)


WRONG = {
    label: {
        "key": NO_KEYS,
        "body": [None, NONE, (), jnp.zeros(())],
        "hazard": [None, HAZARDS[:3], HAZARDS[:0], jnp.zeros(()), 7],
        "batch": NO_COUNTS,
        "rows": NO_COUNTS,
    },
    labels.best_estimator: {"paths": NO_COUNTS},
    play: {
        "key": NO_KEYS,
        "values": [lambda _: jnp.zeros(3), lambda _: jnp.zeros((8, 2)), lambda _: None],
        "episodes": NO_COUNTS,
        "batch": NO_COUNTS,
    },
    learn: {"key": NO_KEYS, "num_envs": NO_COUNTS, "batch": NO_COUNTS, "network": [None, "big"]},
    fitted: {
        "key": NO_KEYS,
        "data": [DATA._replace(threat=DATA.threat[:7]), DATA._replace(features=None)],
        "hidden": [(), None, 5, (0,), (10**9,), (8,) * 99],
        "batch": NO_COUNTS,
    },
    built: {"key": NO_KEYS, "x": [None, -1, float("nan"), "x"], "states": NO_COUNTS},
    shield.shield: {"threat": NO_ROWS, "x": [None, "x", float("nan"), jnp.zeros(3), np.zeros(1)]},
    shield.correct: {"action": [None, 1.5, "a", jnp.zeros(2), jnp.zeros((3, 3)), THREE > 0]},
    shield.masked_argmax: {"values": [*NO_ROWS, jnp.zeros(2)], "admissible": NO_ROWS},
    shield.masked_sample: {"key": NO_KEYS, "admissible": NO_ROWS},
}
GOOD = {
    labels.best_estimator: {"sub": SUB, "paths": 8},
    shield.shield: {"threat": THREE, "x": 0.5},
    shield.correct: {"threat": THREE, "action": jnp.asarray(1), "x": 0.5},
    shield.masked_argmax: {"values": THREE, "admissible": THREE < 0.5},
    shield.masked_sample: {"key": KEY, "admissible": THREE < 0.5},
}
NAMES = {"data": ("features", "threat"), "body": ("body", "hazard")}


@pytest.mark.parametrize(
    ("function", "argument"),
    [(function, argument) for function, wrong in WRONG.items() for argument in wrong],
    ids=lambda part: part if isinstance(part, str) else part.__name__,
)
def test_an_argument_that_cannot_be_is_named(function, argument):
    good = GOOD.get(function, {})
    if good:
        function(**good)
    names = NAMES.get(argument, (argument, f"config.{argument}"))
    for value in WRONG[function][argument]:
        with pytest.raises(ValueError, match="it must") as found:
            function(**{**good, argument: value})
        assert str(found.value).startswith(names), (value, found.value)
