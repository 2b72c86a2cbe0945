"""Input made at random: a clear error or a good run, never a traceback, and nothing begun.

RP_FUZZ sets the number of examples of the slow part.
"""

import contextlib
import dataclasses
import functools
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
    circuit,
    compare,
    frontier,
    frozen_lake,
    jam,
    mpc,
    patrol,
    point_gather,
    resumable,
    sampling,
    shielded,
    theorems,
)
from rp_jax import storage
from rp_jax.cli import experiment, main
from rp_jax.cli.certify_command import CertifyOptions
from rp_jax.cli.crashes_command import CrashesOptions
from rp_jax.cli.evaluate_command import EvaluateOptions
from rp_jax.cli.rare_command import RareOptions
from rp_jax.runs import dataclass_json, train
from rp_jax.runs.train import Process

MODULES = {
    "circuit": circuit,
    "jam": jam,
    "point_gather": point_gather,
    "patrol": patrol,
    "frontier": frontier,
}
OTHERS = {  # modules with a command line of their own, and what it needs
    everything: [],
    compare: ["--env", "jam"],
    frozen_lake: [],
    mpc: ["--env", "jam", "--horizon", "2"],
    sampling: [],
    shielded: [],
    theorems: [],
}
COMMANDS = {  # of rp-jax: their options, and what they need
    "certify": (CertifyOptions, ["--run", "nowhere", "--c", "0.1"]),
    "crashes": (CrashesOptions, ["--run", "nowhere", "--out", "there"]),
    "evaluate": (EvaluateOptions, ["--run", "nowhere"]),
    "rare": (RareOptions, ["--run", "nowhere", "--out", "there"]),
    "train": (Process, ["--env", "rp_jax.envs.circuit"]),
    "check": (Process, ["--env", "no_such_world"]),
}


def called(module):
    """Runs a module's command line on the arguments of the process."""
    if hasattr(module, "COMMAND"):
        resumable.main(module.COMMAND, sys.argv[1:])
    else:
        module.main()


LINES = {  # by name: (function, its options, what it needs)
    **{
        module.__name__.rpartition(".")[2]: (functools.partial(called, module), module.Config, need)
        for module, need in OTHERS.items()
    },
    **{name: (main.main, options, need) for name, (options, need) in COMMANDS.items()},
}
PATIENCE = 300  # seconds for one example, on a machine that is busy
MANY = int(os.environ.get("RP_FUZZ", "100"))  # a refused command line takes 70 ms, a good one 440

VALUES = "0 1 -1 2.5 nan inf -inf 1e400 1e-400 True None quick paper plans"
NAMES = (
    "seeds seed out threat devices x c refunds shield learning-penalty insecure-penalty penalty "
    "episodes figures fidelity "
    "baseline obstacles test-obstacles track test-tracks bombs preset recipe resume wall.states "
    "wall.paths wall.sampling wall.miss-rate wall.fit.hidden wall.fit.steps wall.fit.validation "
    "planning.steps planning.num-envs planning.batch planning.replay planning.replay-start "
    "planning.n-step planning.learner.gamma planning.learner.period planning.network"
)
FIELDS = (
    "seeds seed x c refunds shield penalty episodes lookahead planning wall test_obstacles fidelity"
)

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
        patch.setattr(train, "train", begin)
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
    ends_well(lambda: experiment.run(MODULES[name].EXPERIMENT, argv), argv)


def call_other(name, argv):
    words = [name, *argv]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["rp-jax", *words] if name in COMMANDS else words)
        ends_well(LINES[name][0], argv)


def words_of(name):
    """Command lines of one of them, most of them with what it needs."""
    _, options, needed = LINES[name]
    fields = [field.name.replace("_", "-") for field in dataclasses.fields(options)]
    names = [*fields, "resume", "set", "test", "x"]
    option = st.tuples(st.sampled_from(names).map("--{}".format), values).map(list)
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
    found = MODULES[name].EXPERIMENT
    try:
        with in_time():
            kind = type(found.presets["quick"]("tuned"))
            config = dataclass_json.restored(kind, changed, "config.json")
            threats = experiment.threats_of(config)
            train.checked(found.make_world(config), config, threats, Process())
    except ValueError:
        pass  # anything else is a failure


class TestOtherCommandLines:
    @given(st.sampled_from(sorted(LINES)).flatmap(words_of))
    @settings(max_examples=40)
    def test_some(self, nothing_runs, found):
        call_other(*found)

    @pytest.mark.slow
    @given(st.sampled_from(sorted(LINES)).flatmap(words_of))
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
            text = {**text, "seal": storage.manifest_checksum(text)}
        (folder / "manifest.json").write_text(json.dumps(text))
        with pytest.raises(storage.StorageError):
            storage.load(folder, "thing", {"a": 1.0})
