"""Figures of Circuit."""

import jax
import numpy as np

from experiments.figures import shared, words
from rp_jax.envs import circuit
from rp_jax.envs.tracks import Track
from rp_jax.plot import maps, scenes
from rp_jax.runs.progress import OnProgress
from rp_jax.runs.train import RunResult
from rp_jax.streams import Stream

ARROWS = 16  # that show the way to drive


def draw(run: RunResult, bar: OnProgress) -> None:
    """All figures of a run, and an animation."""
    folder = shared.figures_of(run)
    bar("figures", 0, 2, "trajectories")
    panels = []
    for variant, params in ((name, run.world.params(name)) for name in run.world.tests):
        demo = circuit.demo_start(params)
        keys = jax.random.split(shared.key_of_figures(run, Stream.STARTS), 7)
        starts = jax.vmap(circuit.reset, (0, None))(keys, params)
        starts = jax.tree.map(lambda a, b: jax.numpy.concatenate([a[None], b]), demo, starts)
        episodes = shared.play(run, params, starts, int(params.time_limit), None)
        title = words.variant(variant).capitalize()
        panels.append((title, scene_of(params.track), episodes))
    scenes.trajectories(panels, folder / "trajectories.png")
    if run.threat is not None:
        bar("figures", 1, 2, "threat maps")
        draw_maps(run)
    bar("figures", 2, 2, "")
    _, scene, episodes = panels[0]
    shared.animation(run, scene, episodes[0], bar)


def scene_of(track: Track) -> scenes.Scene:
    """The track, and arrows along its centre line."""
    centre, onward = np.asarray(track.centre), np.asarray(track.onward)
    way = np.cumsum(np.linalg.norm(np.diff(centre, axis=0, append=centre[:1]), axis=1))
    places = np.searchsorted(way, np.arange(ARROWS) / ARROWS * way[-1])
    pairs = np.stack([centre[places], onward[places]], axis=1)
    return scenes.Scene(np.asarray(track.walls), way=pairs)


def draw_maps(run: RunResult) -> None:
    """The threat of one wall point at three speeds, and of the whole track for two velocities."""
    shared.wall_maps(run, (0.1, 0.04, -0.04))
    walls = np.asarray(run.agents.pmdp.params.track.walls)
    (left, bottom), (right, top) = walls.min(axis=0) - 0.1, walls.max(axis=0) + 0.1
    velocities = {
        "Agent heading along x at 0.1 room units / step": (0.0, 0.1),
        "Agent heading along y at 0.1 room units / step": (np.pi / 2, 0.1),
    }
    state = circuit.demo_start(run.agents.pmdp.params)
    sums = shared.threat_of_all(run, state, (left, right, bottom, top), velocities)

    def decorate(axis, i: int) -> None:
        axis.plot(*walls.T, ".", color="#38a169", markersize=2, label="wall")

    maps.heat_maps(sums, run.config.x, shared.figures_of(run) / "threat_of_all.png", decorate)
