"""Figures of Jam."""

import jax
import numpy as np

from experiments.figures import shared, words
from rp_jax.dynamics import Vehicle
from rp_jax.envs import jam
from rp_jax.plot import maps, scenes
from rp_jax.runs.progress import OnProgress
from rp_jax.runs.train import RunResult
from rp_jax.streams import Stream


def draw(run: RunResult, bar: OnProgress) -> None:
    """All figures of a run, and an animation."""
    folder, quarters = shared.figures_of(run), run.world.settings.get("fidelity") == "paper"
    scene = scene_of(run.agents.pmdp.params, quarters)
    bar("figures", 0, 2, "trajectories")
    panels = []
    for variant, test in ((name, run.world.params(name)) for name in run.world.tests):
        keys = jax.random.split(shared.key_of_figures(run, Stream.STARTS), 20)
        starts = jax.vmap(jam.reset, (0, None))(keys, test)
        limit = int(test.time_limit)
        episodes = shared.play(run, test, starts, limit, present_obstacles)
        panels.append((words.variant(variant).capitalize(), scene, episodes))
        if variant == f"N={run.world.settings['num_obstacles']}" or len(panels) == 1:
            shown = episodes
    scenes.trajectories(panels, folder / "trajectories.png")
    if run.threat is not None:
        bar("figures", 1, 2, "threat maps")
        draw_maps(run)
    bar("figures", 2, 2, "")
    ended = [e for e in shown if len(e.action) < limit] or shown
    longest = max(ended, key=lambda e: len(e.action))
    shared.animation(run, scene, longest, bar)


def scene_of(params: jam.Params, round_zones: bool = False) -> scenes.Scene:
    """The room with its safety zones, its exit, and the point that progress is measured to."""
    room = float(params.room)
    return scenes.Scene(
        jam.wall_points(room),
        [(0.0, 0.0), (0.0, room), (room, 0.0)],
        jam.ZONE,
        round_zones,
        exit=np.asarray([[room - jam.EXIT, room], [room, room]]),
        goal=params.goal.tolist(),
    )


def present_obstacles(states: jam.State) -> Vehicle:
    """The obstacles, those that have disappeared at nan, which is not drawn."""
    shown = states.present[..., None]
    position = np.where(shown, states.obstacles.position, np.nan)
    return states.obstacles.replace(position=position)


def draw_maps(run: RunResult) -> None:
    """Figure 4: single-obstacle threats, and their sums for two velocities."""
    cases = [(0.0, 0.06, 0.1), (np.pi, 0.06, 0.1), (np.pi / 2, 0.06, 0.0)]
    ways = ("ahead, like the agent,", "the opposite way", "to the agent's left")
    titles = [
        f"Obstacle driving {way} at {v:g},\nagent at {own:g} room units / step"
        for way, (_, v, own) in zip(ways, cases, strict=True)
    ]

    def features(places: np.ndarray, i: int) -> np.ndarray:
        heading, speed, own = cases[i]
        rest = [np.cos(heading), np.sin(heading), speed, own]
        return np.concatenate([places, np.tile(rest, (len(places), 1))], axis=-1)

    panels = shared.threat_of_one(run, "obstacle", titles, features)
    maps.heat_maps(panels, run.config.x, shared.figures_of(run) / "threat_of_one_obstacle.png")
    shared.wall_maps(run, (0.1, 0.0, -0.1))
    key = shared.key_of_figures(run, Stream.STARTS)
    state = jam.reset(key, run.agents.pmdp.params)
    velocities = {
        "Agent heading 45 degrees left of x\nat 0.1 room units / step": (np.pi / 4, 0.1),
        "Agent heading against x\nat 0.05 room units / step": (np.pi, 0.05),
    }
    sums = shared.threat_of_all(run, state, (0.0, 3.0, 0.0, 3.0), velocities)
    others = jax.tree.map(np.asarray, state.obstacles)

    def decorate(axis, i: int) -> None:
        axis.quiver(
            *others.position.T, *(others.heading * others.speed[:, None]).T, color="#63b3ed"
        )
        label = "obstacle, and its velocity"
        axis.plot(*others.position.T, "o", color="#63b3ed", markersize=4, label=label)
        wall = {"marker": ".", "linestyle": "none", "markersize": 2, "clip_on": False}
        axis.plot(*jam.wall_points().T, **wall, color="#38a169", label="wall")

    maps.heat_maps(sums, run.config.x, shared.figures_of(run) / "threat_of_all.png", decorate)
