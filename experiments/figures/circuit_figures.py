"""Figures of Circuit."""

import jax
import numpy as np

from experiments.figures import shared
from rp_jax.envs import circuit
from rp_jax.plot import maps, scenes
from rp_jax.runs.progress import OnProgress
from rp_jax.runs.train import RunResult
from rp_jax.streams import Stream


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
        panels.append((variant, scenes.Scene(np.asarray(params.track.walls)), episodes))
    scenes.trajectories(panels, folder / "trajectories.png")
    if run.threat is not None:
        bar("figures", 1, 2, "threat maps")
        draw_maps(run)
    bar("figures", 2, 2, "")
    _, scene, episodes = panels[0]
    shared.animation(run, scene, episodes[0], bar)


def draw_maps(run: RunResult) -> None:
    """The threat of one wall point at three speeds, and of the whole track for two velocities."""
    shared.wall_maps(run, (0.1, 0.04, -0.04))
    walls = np.asarray(run.agents.pmdp.params.track.walls)
    (left, bottom), (right, top) = walls.min(axis=0) - 0.1, walls.max(axis=0) + 0.1
    velocities = {
        "heading 0 deg, speed 0.1": (0.0, 0.1),
        "heading 90 deg, speed 0.1": (np.pi / 2, 0.1),
    }
    state = circuit.demo_start(run.agents.pmdp.params)
    sums = shared.threat_of_all(run, state, (left, right, bottom, top), velocities)

    def decorate(axis, i: int) -> None:
        axis.plot(*walls.T, ",", color="white")

    maps.heat_maps(sums, run.config.x, shared.figures_of(run) / "threat_of_all.png", decorate)
