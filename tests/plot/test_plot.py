import importlib.util
import os
import subprocess
import sys

import numpy as np
import pytest

if importlib.util.find_spec("matplotlib") is None:
    pytest.skip("figures need matplotlib", allow_module_level=True)

import matplotlib
from matplotlib import image as images
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from PIL import Image

from rp_jax.plot import curves, finite, growth, maps, scenes

rng = np.random.default_rng(0)


@pytest.fixture
def path(tmp_path):
    """Where a figure goes; pyplot's figures and its backend must be left as they are."""
    plt.close("all")
    own, backend = plt.figure(), matplotlib.get_backend()
    yield tmp_path / "figure.png"
    assert plt.get_fignums() == [own.number]
    assert matplotlib.get_backend() == backend
    plt.close("all")


@pytest.fixture
def saved(monkeypatch):
    """The figures that are saved."""
    figures, save = [], Figure.savefig

    def kept(figure, *args, **named):
        figures.append(figure)
        save(figure, *args, **named)

    monkeypatch.setattr(Figure, "savefig", kept)
    return figures


def legend_of(figure):
    """The texts of the legend below a figure."""
    (legend,) = figure.legends
    return [text.get_text() for text in legend.get_texts()]


def test_importing_and_drawing_leave_the_backend_and_pyplot_as_they_are(tmp_path):
    names = ("curves", "finite", "growth", "legend", "maps", "scenes")
    code = f"""
import sys, matplotlib
from pathlib import Path
from rp_jax.plot import {", ".join(names)}
assert "matplotlib.pyplot" not in sys.modules
rows = [{{"step": 1, "loss": 1.0, "validation_loss": 1.0}}]
curves.fit_curves({{"wall": rows}}, Path({str(tmp_path / "a.png")!r}))
assert matplotlib.get_backend() == "svg"
from matplotlib import pyplot
assert pyplot.get_fignums() == []
"""
    subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "MPLBACKEND": "svg"}, check=True
    )
    drawn(tmp_path / "a.png")


def drawn(path):
    """The picture (height, width, 4): not a blank one."""
    picture = images.imread(path)
    assert min(picture.shape[:2]) > 100
    assert picture.std() > 0.01
    return picture


def history(seeds=2, chunks=5, silent=1):
    """Rows as in metrics.jsonl; no episode ends in the first `silent` chunks."""
    return [
        {
            "seed": seed,
            "steps": 100 * (i + 1),
            "episodes": 0 if i < silent else 10,
            "return_mean": float("nan") if i < silent else float(i + seed),
            "crashes": 0 if i < silent else i,
            "insecure": 0.1 * i,
        }
        for i in range(chunks)
        for seed in range(seeds)
    ]


def test_methods_are_compared(path, saved):
    rows = [{**row, "method": f"method {row['seed']}"} for row in history(seeds=3)]
    level = {"method": "MPC (1 step)", "return_mean": 1.0, "crash_rate": 0.1}
    curves.methods({"one": rows, "point_gather": rows[:5]}, path, {"one": [level]})
    drawn(path)
    assert [axis.get_title() for axis in saved[0].axes[:2]] == ["One", "Point gather"]
    one = [text.get_text() for text in saved[0].axes[4].get_legend().get_texts()]
    assert one == ["method 0", "method 1", "method 2", "MPC (1 step)"]


@pytest.mark.parametrize("silent", [0, 1, 4])
def test_learning_curves(silent, path):
    curves.learning_curves(history(silent=silent), "task", path)
    drawn(path)


def test_learning_curves_of_a_run_in_which_no_episode_ended(path):
    curves.learning_curves(history(silent=5), "task", path)
    drawn(path)


def test_learning_curves_show_what_happened(path, saved):
    curves.learning_curves(history(), "my_task: RP (x=0.01)", path)
    assert saved[0].get_suptitle() == "My task: RP (x=0.01)"
    returns, crashes, insecure = saved[0].axes
    assert [text.get_text() for text in returns.get_legend().get_texts()] == ["mean of 2 agents"]
    assert "at least 256 episodes of an agent" in insecure.get_xlabel()
    mean = returns.get_lines()[-1]
    np.testing.assert_array_equal(mean.get_xdata(), [200, 300, 400, 500])
    np.testing.assert_allclose(mean.get_ydata(), [1.5, 2.5, 3.5, 4.5])
    np.testing.assert_allclose(crashes.get_lines()[0].get_ydata(), [10, 20, 30, 40])
    np.testing.assert_allclose(insecure.get_lines()[0].get_ydata(), [0, 10, 20, 30, 40])


def chunks_of(*counts, seed=0, crashes=0):
    """Rows with so many episodes, whose return is the number of the chunk."""
    return [
        {
            "seed": seed,
            "steps": 100 * (i + 1),
            "episodes": count,
            "return_mean": float(i) if count else None,
            "crashes": min(count, crashes),
        }
        for i, count in enumerate(counts)
    ]


def test_the_few_episodes_that_end_first_are_no_point_of_a_curve():
    rows = curves.pooled(chunks_of(0, 6, 600, 1, 1999, 400, 5, crashes=5))
    assert [row["steps"] for row in rows] == [300, 500, 700]
    assert [row["episodes"] for row in rows] == [606, 2000, 405]
    assert [row["crashes"] for row in rows] == [10, 6, 10]
    found = [row["return_mean"] for row in rows]
    np.testing.assert_allclose(found, [1206 / 606, (3 + 4 * 1999) / 2000, 2030 / 405])


def test_points_hold_enough_episodes_of_a_seed_or_a_tenth_of_all():
    every = curves.pooled(chunks_of(*[300] * 12))
    assert [row["episodes"] for row in every] == [300] * 12
    twos = curves.pooled(chunks_of(*[200] * 20, seed=1) + chunks_of(*[200] * 20, seed=2))
    assert [row["episodes"] for row in twos] == [400] * 20
    assert [row["seed"] for row in twos] == [1, 2] * 10
    few = curves.pooled(chunks_of(*[1] * 30))
    assert [row["episodes"] for row in few] == [3] * 10


def test_pooled_curves_may_be_empty():
    assert curves.pooled([]) == []
    assert curves.pooled(chunks_of(0, 0)) == []
    assert [row["episodes"] for row in curves.pooled(chunks_of(0, 1))] == [1]


@pytest.mark.parametrize("kinds", [["wall"], ["wall", "obstacle"]])
def test_fit_curves(kinds, path):
    rows = [{"step": i, "loss": 1 / i, "validation_loss": 1.1 / i} for i in range(1, 20)]
    curves.fit_curves(dict.fromkeys(kinds, rows), path)
    picture = drawn(path)
    assert picture.shape[1] > 500 * len(kinds)


def test_comparisons(path, saved):
    rows = [
        {"hazard": h, "test": "all", "sampling": s, "states": n, "rmse": 1 / n, "far_off": 0.0}
        for h in ("wall", "car")
        for s in ("uniform", "preferential")
        for n in (100, 200, 400)
        for _ in range(2)
    ]
    curves.comparison(
        rows,
        panels=("hazard", "test"),
        line="sampling",
        horizontal="states",
        vertical=("rmse", "far_off"),
        path=path,
    )
    drawn(path)
    axes = saved[0].axes
    assert axes[0].get_ylabel() == "root mean square error of the threat"
    assert axes[2].get_ylabel() == "far off"
    assert {axis.get_xlabel() for axis in axes} == {"labelled states"}


def test_heat_maps_say_what_their_axes_lines_and_colours_are(path, saved):
    def decorate(axis, i):
        axis.plot([0], [1], "o", label="bomb")

    own = panel()._replace(horizontal="bomb ahead, room units", vertical="bomb to the left")
    maps.heat_maps([panel(), own], 0.25, path, decorate)
    first, second, bar = saved[0].axes
    assert (first.get_xlabel(), first.get_ylabel()) == ("x, room units", "y, room units")
    assert (second.get_xlabel(), second.get_ylabel()) == (own.horizontal, own.vertical)
    assert bar.get_ylabel() == "threat of the least threatening action"
    assert legend_of(saved[0]) == ["threat equal to the threshold, 0.25", "bomb"]


def panel(low=0.0, high=1.0):
    return maps.Panel("title", rng.uniform(low, high, (20, 30)), (-1.0, 2.0, 0.0, 2.0))


@pytest.mark.parametrize("count", [1, 2, 4])
def test_heat_maps_of_any_number(count, path):
    decorated = []
    panels = [panel() for _ in range(count)]
    maps.heat_maps(panels, 0.1, path, lambda axis, i: decorated.append(i))
    drawn(path)
    assert decorated == list(range(count))


@pytest.mark.parametrize(
    ("threat", "x"),
    [((0, 1), 0.0), ((0, 1), float("inf")), ((0, 0), 0.1), ((1, 40), 5.0), ((1, 40), 50.0)],
)
def test_heat_maps_of_any_threat_and_threshold(threat, x, path):
    maps.heat_maps([panel(*threat)], x, path)
    drawn(path)


def test_the_line_stands_where_the_threat_equals_the_threshold(path):
    slope = np.tile(np.linspace(0, 1, 101), (50, 1))
    maps.heat_maps([maps.Panel("", slope, (0.0, 1.0, 0.0, 0.5))], 0.25, path)
    red, green, blue = np.moveaxis(drawn(path)[:-60, :, :3], -1, 0)  # without the legend
    cyan = (green > red + 0.2) & (blue > red + 0.2)
    columns = np.nonzero(cyan)[1]
    assert 0 <= np.ptp(columns) < 5  # one upright line
    assert 100 < columns.mean() < 200  # at a quarter of the panel


def episode(steps=6, obstacles=2, crashed=False):
    turn = rng.uniform(-np.pi, np.pi, (steps, obstacles + 1))
    facing = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    threat = rng.uniform(0, 1, (steps, 15))
    return scenes.Episode(
        position=rng.uniform(0, 3, (steps, 2)),
        heading=facing[:, 0],
        obstacles=rng.uniform(0, 3, (steps, obstacles, 2)),
        obstacle_headings=facing[:, 1:],
        action=rng.integers(0, 15, steps),
        threat=threat,
        admissible=threat < 0.5,
        secure=rng.random(steps) < 0.5,
        hit=np.arange(steps) == (steps - 1 if crashed else steps),
    )


WALLS = np.asarray([[x, y] for x in np.linspace(0, 3, 31) for y in np.linspace(0, 3, 31)])
SCENE = scenes.Scene(WALLS[(WALLS == 0).any(-1) | (WALLS == 3).any(-1)])
MARKED = SCENE._replace(
    corners=[(0.0, 0.0)],
    zone=0.5,
    rings=[(np.asarray([[1.0, 2.0]]), 0.3, scenes.GOOD)],
    names={scenes.GOOD: "apple", scenes.OBSTACLE: "obstacle"},
    exit=np.asarray([[2.2, 3.0], [3.0, 3.0]]),
    goal=(2.6, 3.0),
    way=np.asarray([[[1.0, 0.5], [0.0, 1.0]]]),
)
STANDING = ["safety zone", "wall", "apple", "exit", "goal", "way to drive"]
CORNERS = [(0.0, 0.0), (0.0, 3.0), (3.0, 0.0), (3.0, 3.0)]
TURNS = (-0.3, -0.1, 0.0, 0.1, 0.3)


@pytest.mark.parametrize("round_zones", [False, True])
@pytest.mark.parametrize("corner", CORNERS)
def test_safety_zones_lie_inside_their_corners(corner, round_zones):
    figure = Figure()
    axis = figure.subplots()
    scenes.draw_scene(axis, SCENE._replace(corners=[corner], zone=0.5, round_zones=round_zones))
    figure.draw_without_rendering()

    def shaded(x, y):
        place = axis.transData.transform((x, y))
        return any(patch.contains_point(place) for patch in axis.patches)

    inward = 1 - 2 * np.asarray(corner) / 3  # along either side
    assert shaded(*(corner + 0.3 * inward))
    assert shaded(*(corner + 0.45 * inward)) == (not round_zones)
    assert not shaded(*(corner + 0.55 * inward))
    assert not shaded(*(corner - 0.1 * inward))
    assert not shaded(1.5, 1.5)


def test_rings_stand_about_their_places_and_more_panels_than_three_get_a_second_line(path):
    rings = [(np.asarray([[1.0, 1.0], [2.0, 1.5]]), 0.3, scenes.BAD)]
    wide = [("room", SCENE._replace(rings=rings), [episode(crashed=True)])] * 4
    scenes.trajectories(wide, path)
    picture = drawn(path)
    assert picture.shape[0] > 0.55 * picture.shape[1]


def test_trajectories(path, saved):
    two = [episode(), episode(steps=1, crashed=True)]
    scenes.trajectories([("One", MARKED, two), ("Two", SCENE, two[:1])], path)
    drawn(path)
    one, other = saved[0].axes
    assert one.get_title() == "One: 1 of 2 episodes crashed"
    assert other.get_title() == "Two: no crash"
    for axis in (one, other):
        assert (axis.get_xlabel(), axis.get_ylabel()) == ("x, room units", "y, room units")
    told = [*STANDING, "path of the agent", "start", "crash"]
    assert legend_of(saved[0]) == told


def test_the_exit_the_goal_and_the_way_to_drive_stand_where_they_are():
    axis = Figure().subplots()
    scenes.draw_scene(axis, MARKED)
    lines = {line.get_label(): line.get_xydata() for line in axis.get_lines()}
    np.testing.assert_array_equal(lines["exit"], [[2.2, 3.0], [3.0, 3.0]])
    np.testing.assert_array_equal(lines["goal"], [[2.6, 3.0]])
    np.testing.assert_array_equal(lines["apple"], [[1.0, 2.0]])
    (arrows,) = [found for found in axis.collections if hasattr(found, "U")]
    np.testing.assert_array_equal(arrows.XY, [[1.0, 0.5]])
    assert (arrows.U, arrows.V) == ([0.0], [1.0])


@pytest.fixture
def animated(tmp_path, monkeypatch):
    """Draws an animation; returns its figure, and what shows a frame."""
    kept, pictures = [], scenes._pictures

    def keeping(figure, moving, show, count):
        kept[:] = figure, show
        return pictures(figure, moving, show, count)

    monkeypatch.setattr(scenes, "_pictures", keeping)

    def draw(scene, shown, x=0.5):
        scenes.animate(scene, shown, (-0.02, 0.0, 0.02), TURNS, x, tmp_path / "episode.gif")
        return kept

    return draw


def test_an_animation_explains_all_that_it_shows(animated):
    figure, _ = animated(MARKED, episode(5, 2, crashed=True))
    moving = ["start", "agent, and its path", "obstacle", "crash"]
    actions = ["chosen action", "inadmissible: threat above 0.5"]
    assert legend_of(figure) == [*STANDING, *moving, *actions]
    world, table, bar = figure.axes
    assert (world.get_xlabel(), world.get_ylabel()) == ("x, room units", "y, room units")
    assert table.get_xlabel() == "turn, radians / step (left is positive)"
    assert table.get_ylabel() == "acceleration, room units / step$^2$"
    assert bar.get_ylabel() == "threat of the action"


@pytest.mark.parametrize("obstacles", [0, 8])
def test_the_legend_of_an_animation_covers_nothing(obstacles, animated):
    figure, show = animated(MARKED, episode(9, obstacles, crashed=True))
    legend = figure.legends[0].get_window_extent()
    assert figure.bbox.x0 <= legend.x0
    assert legend.x1 <= figure.bbox.x1
    assert figure.bbox.y0 <= legend.y0
    for t in (0, 4, 8):
        show(t)
        for axis in figure.axes:
            around = axis.get_tightbbox()
            assert legend.y1 <= around.y0
            assert around.y1 <= figure.bbox.y1


def test_the_greatest_acceleration_is_at_the_top_and_left_turns_are_on_the_left(animated):
    braking_right, speeding_left = 0, 14  # rows from slow to fast, turns from right to left
    shown = episode(2, 0)._replace(
        action=np.asarray([braking_right, speeding_left]),
        admissible=np.arange(15) == np.asarray([[14], [0]]),
        threat=np.tile(np.linspace(0.01, 0.15, 15), (2, 1)),
    )
    figure, show = animated(SCENE, shown)
    table = figure.axes[1]
    up = [label.get_text() for label in table.get_yticklabels()]
    assert up == ["-0.02", "+0.00", "+0.02"]
    heights = table.transData.transform([(0, y) for y in table.get_yticks()])[:, 1]
    assert (np.diff(heights) > 0).all()
    across = [label.get_text() for label in table.get_xticklabels()]
    assert across == ["+0.30", "+0.10", "+0.00", "-0.10", "-0.30"]
    (frame,), (crosses,) = table.patches, table.get_lines()
    show(0)
    assert frame.get_xy() == (3.5, -0.5)  # bottom right
    assert len(crosses.get_xydata()) == 14
    assert [0, 2] not in crosses.get_xydata().tolist()  # top left
    np.testing.assert_allclose(table.images[0].get_array()[2, 0], 0.15)  # the last action
    np.testing.assert_allclose(table.images[0].get_array()[0, 4], 0.01)  # the first
    show(1)
    assert frame.get_xy() == (-0.5, 1.5)  # top left
    assert [4, 0] not in crosses.get_xydata().tolist()


def test_crashes_are_marked_once_they_have_happened(animated):
    shown = episode(4, 0)._replace(hit=np.asarray([False, True, False, False]))
    figure, show = animated(SCENE, shown)
    (crashes,) = [line for line in figure.axes[0].get_lines() if line.get_label() == "crash"]
    for t, count in enumerate((0, 1, 1, 1)):
        show(t)
        np.testing.assert_array_equal(crashes.get_xydata(), shown.position[1 : 1 + count])
    assert figure.axes[0].get_title() == "step 3"


@pytest.mark.parametrize("obstacles", [0, 2])
def test_an_animation_has_a_frame_per_step(obstacles, tmp_path):
    told = []
    path = tmp_path / "episode.gif"
    shown = episode(5, obstacles, crashed=True)
    scenes.animate(SCENE, shown, (-0.02, 0.0, 0.02), TURNS, 0.5, path, lambda *n: told.append(n))
    with Image.open(path) as picture:
        assert picture.format == "GIF"
        assert picture.info["duration"] > 300  # short episodes are shown slowly
        assert picture.n_frames == 5
    assert told[-1] == (5, 5)
    assert plt.get_fignums() == []


@pytest.mark.parametrize("x", [0.0, float("inf")])
def test_an_animation_of_one_step_at_any_threshold(x, tmp_path):
    path = tmp_path / "episode.gif"
    scenes.animate(SCENE, episode(1, 1), (-0.02, 0.0, 0.02), TURNS, x, path)
    assert path.stat().st_size > 1000


def test_figures_of_finite_cmdps(tmp_path):
    plt.close("all")
    threat = rng.uniform(size=(4, 2, 3)) * [[[0, 1, 1]]]
    finite.lake(
        ["SFH", "FFG"], threat, ("left", "down", "right", "up"), "title", tmp_path / "a.png"
    )
    rows = [
        {
            "variant": variant,
            "baseline": baseline,
            "rule": rule,
            "c": c,
            "return_mean": None if c < 0.1 else 0.5,
            "danger": None if c < 0.1 else 0.0,
            "share": None if c < 0.1 else 0.9,
        }
        for variant in ("one", "two")
        for baseline in ("eta 0", "eta*")
        for rule in ("paper", "tight")
        for c in (0.01, 0.1, 1.0)
    ]
    optima = [
        {"variant": v, "c": c, "optimum": c, "lagrangian": None, "lagrangian_danger": None}
        for v in ("one", "two")
        for c in (0.01, 0.1, 1.0)
    ]
    finite.budgets(rows, optima, ("eta 0", "eta*"), tmp_path / "b.png")
    finite.shares(rows, ("paper", "tight"), tmp_path / "c.png")
    for name in ("a", "b", "c"):
        drawn(tmp_path / f"{name}.png")
    assert plt.get_fignums() == []


@pytest.mark.parametrize("panels", [1, 3])
def test_growth(panels, path):
    one = {
        "title": "title",
        "size": "environments",
        "vertical": "step",
        "sizes": [1, 4, 16],
        "seconds": [1.0, 2.0, 4.0],
        "fastest": [0.9, 1.9, 4.0],
        "slowest": [1.1, 2.1, 8.0],
        "slope": 0.5,
        "fitted": 2,
    }
    growth.growth(panels * [one], path)
    drawn(path)
