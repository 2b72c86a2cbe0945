"""Input made at random: a clear error or a good run, never a traceback, and nothing begun.

RP_FUZZ sets the number of examples of the slow part.
"""

import contextlib
import dataclasses
import itertools
import json
import os
import signal
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments import all as everything
from experiments import (
    certify,
    circuit,
    cli,
    compare,
    crashes,
    frontier,
    frozen_lake,
    jam,
    mpc,
    patrol,
    pipeline,
    point_gather,
    rare,
    sampling,
    shielded,
    theorems,
)
from experiments import settings as kept
from rp_jax import storage

MODULES = {  # presets, and how the task is made
    "circuit": (circuit.PRESETS, circuit.make_task),
    "jam": (jam.PRESETS, jam.make_task),
    "point_gather": (point_gather.PRESETS, point_gather.make_task),
    "patrol": (jam.PRESETS, patrol.make_task),
    "frontier": (frontier.PRESETS, jam.make_task),
}
OTHERS = {  # with a command line of their own
    module.__name__.rpartition(".")[2]: module
    for module in (
        *(everything, certify, compare, crashes, frozen_lake, mpc, rare, sampling, shielded),
        theorems,
    )
}
PATIENCE = 300  # seconds for one example, on a machine that is busy
MANY = int(os.environ.get("RP_FUZZ", "100"))  # a refused command line takes 70 ms, a good one 440

VALUES = "0 1 -1 2.5 nan inf -inf 1e400 1e-400 True None quick paper plans"
NAMES = (
    "seeds seed out threat x learning-penalty learning-toll penalty episodes figures fidelity "
    "baseline obstacles test-obstacles track test-tracks bombs preset recipe resume wall.states "
    "wall.paths wall.sampling wall.prudence wall.fit.hidden wall.fit.steps wall.fit.validation "
    "planning.steps planning.num-envs planning.batch planning.replay planning.replay-start "
    "planning.n-step planning.learner.gamma planning.learner.period planning.network"
)
FIELDS = "seeds seed x out threat penalty episodes figures planning wall test_obstacles fidelity"

values = st.one_of(
    st.sampled_from(VALUES.split()),
    st.integers().map(str),
    st.floats().map(str),
    st.text(st.characters(exclude_categories=["Cs"]), max_size=8),
)
options = st.tuples(st.sampled_from(NAMES.split()).map("--{}".format), values).map(list)
stray = values.map(lambda value: [value])
words = st.lists(options | stray, max_size=3).map(lambda parts: [*itertools.chain(*parts)])
experiments = st.sampled_from(sorted(MODULES))
plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)
changes = st.dictionaries(st.sampled_from(FIELDS.split()), plain)


class BegunError(Exception):
    """The input was good."""


@pytest.fixture(scope="module")
def nothing_runs(tmp_path_factory):
    """Good input ends before anything is written."""

    def begin(*args):
        raise BegunError

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("fuzz"))
        patch.setattr(storage, "new_folder", begin)
        patch.setattr(pipeline, "run", begin)
        patch.setattr(theorems, "run", begin)
        yield


@contextlib.contextmanager
def in_time():
    """Nothing hangs."""

    def stop(*_):
        raise TimeoutError(f"not done in {PATIENCE} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(PATIENCE)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def ends_well(main, argv):
    with pytest.raises((BegunError, SystemExit)) as stop, in_time():
        main()
    helped = "--help" in argv or "-h" in argv
    assert stop.type is BegunError or stop.value.code == 2 or helped


def call(name, argv):
    ends_well(lambda: cli.main(name, "", *MODULES[name], argv), argv)


def call_other(name, argv):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [name, *argv])
        ends_well(OTHERS[name].main, argv)


def words_of(name):
    """Command lines of one of the others, most of them with what it needs."""
    needed = {
        "certify": ["--run", "nowhere", "--c", "0.1"],
        "compare": ["--env", "jam"],
        "crashes": ["--run", "nowhere", "--out", "there"],
        "mpc": ["--env", "jam", "--horizon", "2"],
        "rare": ["--run", "nowhere", "--out", "there"],
    }.get(name, [])
    names = [f.name.replace("_", "-") for f in dataclasses.fields(OTHERS[name].Config)]
    option = st.tuples(st.sampled_from([*names, "resume"]).map("--{}".format), values).map(list)
    parts = st.lists(option | stray, max_size=3).map(lambda parts: [*itertools.chain(*parts)])
    return st.tuples(st.just(name), st.sampled_from([needed, []]), parts).map(
        lambda found: (found[0], [*found[1], *found[2]])
    )


class TestCommandLines:
    @given(experiments, words)
    @settings(max_examples=40)
    def test_some(self, nothing_runs, name, argv):
        call(name, argv)

    @pytest.mark.slow
    @given(experiments, words)
    @settings(max_examples=MANY)
    def test_many(self, nothing_runs, name, argv):
        call(name, argv)


def read_back(name, changed):
    presets, make_task = MODULES[name]
    try:
        with in_time():
            config = kept.restored(type(presets["quick"]("tuned")), changed, "config.json")
            pipeline.checked(make_task, config)
    except ValueError:
        pass  # anything else is a failure


class TestOtherCommandLines:
    @given(st.sampled_from(sorted(OTHERS)).flatmap(words_of))
    @settings(max_examples=40)
    def test_some(self, nothing_runs, found):
        call_other(*found)

    @pytest.mark.slow
    @given(st.sampled_from(sorted(OTHERS)).flatmap(words_of))
    @settings(max_examples=MANY)
    def test_many(self, nothing_runs, found):
        call_other(*found)


class TestSettingsReadBack:
    @given(experiments, changes)
    @settings(max_examples=40)
    def test_some(self, name, changed):
        read_back(name, changed)

    @pytest.mark.slow
    @given(experiments, changes)
    @settings(max_examples=MANY)
    def test_many(self, name, changed):
        read_back(name, changed)


@given(value=plain)
def test_manifests_of_anything_are_refused(value, tmp_path_factory):
    folder = tmp_path_factory.mktemp("manifest")
    for text in (value, {"format": storage.FORMAT, "kind": "thing", "about": {}, "arrays": value}):
        if isinstance(text, dict):
            text = {**text, "seal": storage.seal(text)}
        (folder / "manifest.json").write_text(json.dumps(text))
        with pytest.raises(storage.StorageError):
            storage.load(folder, "thing", {"a": 1.0})
