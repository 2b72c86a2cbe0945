"""What the paper's figures call things, and what they mark in the tasks' rooms."""

import importlib.util

import jax
import numpy as np
import pytest

if importlib.util.find_spec("matplotlib") is None:
    pytest.skip("figures need matplotlib", allow_module_level=True)

from experiments.figures import circuit_figures, jam_figures, point_gather_figures, words
from rp_jax.envs import circuit, jam, point_gather
from rp_jax.plot import scenes


@pytest.mark.parametrize(
    ("name", "plain"),
    [
        ("N=8", "8 obstacles"),
        ("N=1", "1 obstacle"),
        ("narrowed", "narrowed track"),
        ("8 bombs", "8 bombs"),
        ("T=100, paper holes", "100 steps, falling ends the episode"),
    ],
)
def test_tests_have_plain_names(name, plain):
    assert words.variant(name) == plain


def test_rows_are_told_in_plain_words_and_keep_all_else():
    rows = [{"variant": "N=3", "method": "MPC (1 step)"}, {"method": "DQN"}]
    plain = [{"variant": "3 obstacles", "method": "MPC (1 step)"}]
    assert words.told(rows) == [*plain, {"method": "DQN"}]


def test_jam_has_its_exit_in_the_gap_of_the_top_wall_and_the_goal_in_the_middle_of_it():
    scene = jam_figures.scene_of(jam.make_params())
    np.testing.assert_allclose(scene.exit, [[2.2, 3.0], [3.0, 3.0]])
    np.testing.assert_allclose(scene.goal, (2.6, 3.0), rtol=1e-6)
    top = scene.walls[scene.walls[:, 1] == 3.0]
    assert top[:, 0].max() <= 2.2


def test_circuit_has_arrows_along_its_centre_line():
    track = circuit.make_params(track="circle").track
    middle = np.asarray(track.centre).mean(axis=0)
    places, ways = np.moveaxis(circuit_figures.scene_of(track).way, 1, 0)
    assert len(places) == circuit_figures.ARROWS
    out = places - middle
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 3.0, rtol=1e-2)
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 1.0, rtol=1e-5)
    turning = out[:, 0] * ways[:, 1] - out[:, 1] * ways[:, 0]
    np.testing.assert_allclose(turning, 3.0, rtol=1e-2)  # always to the left


def test_point_gather_names_apples_and_bombs_by_their_colours():
    state = point_gather.reset(jax.random.key(0), point_gather.make_params())
    scene = point_gather_figures.scene_of(state)
    named = [scene.names[colour] for colour in scene.colours]
    assert named == ["apple, and its reach"] * 2 + ["bomb, and its reach"] * 8
    assert [colour for _, _, colour in scene.rings] == [scenes.GOOD, scenes.BAD]
