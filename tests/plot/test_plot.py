import importlib.util

import numpy as np
import pytest

if importlib.util.find_spec("matplotlib") is None:
    pytest.skip("figures need matplotlib", allow_module_level=True)

from matplotlib import image as images
from matplotlib import pyplot as plt
from PIL import Image

from rp_jax.plot import curves, finite, growth, maps, scenes

rng = np.random.default_rng(0)


@pytest.fixture
def path(tmp_path):
    """Where a figure goes; none may be left open."""
    plt.close("all")
    yield tmp_path / "figure.png"
    assert plt.get_fignums() == []


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


def test_methods_are_compared(path):
    rows = [{**row, "method": f"method {row['seed']}"} for row in history(seeds=3)]
    curves.methods({"one": rows, "two": rows[:5]}, path)
    drawn(path)


@pytest.mark.parametrize("silent", [0, 1, 4])
def test_learning_curves(silent, path):
    curves.learning_curves(history(silent=silent), "task", path)
    drawn(path)


def test_learning_curves_of_a_run_in_which_no_episode_ended(path):
    curves.learning_curves(history(silent=5), "task", path)
    drawn(path)


def test_learning_curves_show_what_happened(path, monkeypatch):
    shown = []
    monkeypatch.setattr(plt, "close", shown.append)
    curves.learning_curves(history(), "task", path)
    monkeypatch.undo()
    returns, crashes, insecure = shown[0].axes
    mean = returns.get_lines()[-1]
    np.testing.assert_array_equal(mean.get_xdata(), [200, 300, 400, 500])
    np.testing.assert_allclose(mean.get_ydata(), [1.5, 2.5, 3.5, 4.5])
    np.testing.assert_allclose(crashes.get_lines()[0].get_ydata(), [0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(insecure.get_lines()[0].get_ydata(), [0, 0.1, 0.2, 0.3, 0.4])
    plt.close(shown[0])


@pytest.mark.parametrize("kinds", [["wall"], ["wall", "obstacle"]])
def test_fit_curves(kinds, path):
    rows = [{"step": i, "loss": 1 / i, "validation_loss": 1.1 / i} for i in range(1, 20)]
    curves.fit_curves(dict.fromkeys(kinds, rows), path)
    picture = drawn(path)
    assert picture.shape[1] > 500 * len(kinds)


def test_comparisons(path):
    rows = [
        {"hazard": h, "test": "all", "sampling": s, "states": n, "rmse": 1 / n, "missed": 0.0}
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
        vertical=("rmse", "missed"),
        path=path,
    )
    drawn(path)


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
    red, green, blue = np.moveaxis(drawn(path)[..., :3], -1, 0)
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
CORNERS = [(0.0, 0.0), (0.0, 3.0), (3.0, 0.0), (3.0, 3.0)]
TURNS = (-0.3, -0.1, 0.0, 0.1, 0.3)


@pytest.mark.parametrize("round_zones", [False, True])
@pytest.mark.parametrize("corner", CORNERS)
def test_safety_zones_lie_inside_their_corners(corner, round_zones):
    figure, axis = plt.subplots()
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
    plt.close(figure)


def test_rings_stand_about_their_places_and_more_panels_than_three_get_a_second_line(path):
    rings = [(np.asarray([[1.0, 1.0], [2.0, 1.5]]), 0.3, scenes.BAD)]
    wide = [("room", SCENE._replace(rings=rings), [episode(crashed=True)])] * 4
    scenes.trajectories(wide, path)
    picture = drawn(path)
    assert picture.shape[0] > 0.55 * picture.shape[1]


def test_trajectories(path):
    two = [episode(), episode(steps=1, crashed=True)]
    scenes.trajectories([("one", SCENE, two), ("two", SCENE, two[:1])], path)
    drawn(path)


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
