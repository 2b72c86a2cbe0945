"""Files of a run with bytes or facts changed: a clear error, or what was there before.

RP_FUZZ sets the number of examples of the slow part.
"""

import json
import os
import shutil

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny import programs_of_a_moment  # noqa: F401

from rp_jax import storage
from rp_jax.runs import saved
from rp_jax.threat import artefact

MANY = int(os.environ.get("RP_FUZZ", "300"))
HARD = MANY // 10  # of those that trace a program
SIZES = ["", "1e12", "-1", "99999999999999999999", "nan", "null", "[]", "{}", '"', "\x00", "é"]

plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)

# (where, how many bytes are dropped there, what is put in their place)
cuts = st.tuples(st.floats(0, 1), st.integers(0, 40), st.binary(max_size=4))
cuts |= st.tuples(st.floats(0, 1), st.integers(0, 5), st.sampled_from(SIZES).map(str.encode))
steps = st.lists(st.integers(0, 30), min_size=1, max_size=6)


@pytest.fixture(scope="module")
def whole(finished):
    agents = saved.load(finished)
    return finished, agents, agents.pmdp.env.sub_rmdps(agents.pmdp.params)


@pytest.fixture(scope="module")
def copy(whole, tmp_path_factory):
    folder = tmp_path_factory.mktemp("copies") / "run"
    shutil.copytree(whole[0], folder)
    return folder


def changed(path, cut):
    """Writes the file with some bytes replaced; returns what to write to undo it."""
    before = path.read_bytes()
    where, drop, put = cut
    at = int(where * len(before))
    path.write_bytes(before[:at] + put + before[at + drop :])
    return before


def forged(path, steps, value):
    """Replaces one thing in the JSON of a manifest, wherever the steps lead, and seals it."""
    before = path.read_bytes()
    manifest = json.loads(before)
    place = manifest
    for step in steps:
        inner = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = inner[step % len(inner)]
        if not isinstance(place[key], dict | list) or not place[key]:
            break
        last, place = (place, key), place[key]
    else:
        place, key = last
    place[key] = value
    path.write_text(json.dumps({**manifest, "seal": storage.manifest_checksum(manifest)}))
    return before


def same(found, wanted):
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


def loaded(path, change, load):
    """What is loaded while the file is changed, or the message of a ValueError."""
    before = change(path)
    try:
        return load()
    except ValueError as error:
        return str(error)
    finally:
        path.write_bytes(before)


def threat(whole, copy, path, change):
    """Of a changed threat function: refused, or the same models."""
    found = loaded(path, change, lambda: artefact.load(copy / "threat", whole[2])[0])
    assert str(copy) in found if isinstance(found, str) else same(found, whole[1].threat.models)


def run(whole, copy, path, change):
    """Of a changed run: refused, or the agents that it had."""
    found = loaded(path, change, lambda: saved.load(copy))
    assert isinstance(found, str) or same(found.weights, whole[1].weights)


def file_of(folder, arrays):
    return next(folder.glob("arrays-*.bin")) if arrays else folder / "manifest.json"


class TestThreatFunctions:
    @given(st.booleans(), cuts)
    @settings(max_examples=40)
    def test_some_bytes(self, whole, copy, arrays, cut):
        threat(whole, copy, file_of(copy / "threat", arrays), lambda path: changed(path, cut))

    @pytest.mark.slow
    @given(st.booleans(), cuts)
    @settings(max_examples=MANY)
    def test_many_bytes(self, whole, copy, arrays, cut):
        threat(whole, copy, file_of(copy / "threat", arrays), lambda path: changed(path, cut))

    @given(steps, plain)
    @settings(max_examples=40)
    def test_some_forged(self, whole, copy, steps, value):
        path = copy / "threat" / "manifest.json"
        threat(whole, copy, path, lambda path: forged(path, steps, value))

    @pytest.mark.slow
    @given(steps, plain)
    @settings(max_examples=MANY)
    def test_many_forged(self, whole, copy, steps, value):
        path = copy / "threat" / "manifest.json"
        threat(whole, copy, path, lambda path: forged(path, steps, value))


FILES = ("metrics.jsonl", "agent/manifest.json", "agent/arrays", "threat/manifest.json")
files = st.sampled_from(FILES)


def agent_file(copy, name):
    return file_of(copy / "agent", True) if name.endswith("arrays") else copy / name


class TestRuns:
    @given(files, cuts)
    @settings(max_examples=20)
    def test_some_bytes(self, whole, copy, name, cut):
        run(whole, copy, agent_file(copy, name), lambda path: changed(path, cut))

    @pytest.mark.slow
    @given(files, cuts)
    @settings(max_examples=HARD)
    def test_many_bytes(self, whole, copy, name, cut):
        run(whole, copy, agent_file(copy, name), lambda path: changed(path, cut))

    @pytest.mark.slow
    @given(steps, plain)
    @settings(max_examples=HARD)
    def test_many_forged(self, whole, copy, steps, value):
        path = copy / "agent" / "manifest.json"
        run(whole, copy, path, lambda path: forged(path, steps, value))
