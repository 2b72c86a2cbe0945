"""Figures of Point Gather."""

import jax
import numpy as np

from experiments.figures import shared
from rp_jax.dynamics import Vehicle
from rp_jax.envs import point_gather
from rp_jax.plot import maps, scenes
from rp_jax.runs.progress import OnProgress
from rp_jax.runs.train import RunResult
from rp_jax.streams import Stream

ROOMS = 6  # in the figure of trajectories


def draw(run: RunResult, bar: OnProgress) -> None:
    """All figures of a run, and an animation."""
    folder, params = shared.figures_of(run), run.agents.pmdp.params
    bar("figures", 0, 2, "trajectories")
    keys = jax.random.split(shared.key_of_figures(run, Stream.STARTS), ROOMS)
    starts = jax.vmap(point_gather.reset, (0, None))(keys, params)
    episodes = shared.play(run, params, starts, int(params.time_limit), objects_left)
    rooms = [scene_of(jax.tree.map(lambda a, i=i: a[i], starts)) for i in range(ROOMS)]
    panels = [(f"Room {i + 1}", rooms[i], [episodes[i]]) for i in range(ROOMS)]
    scenes.trajectories(panels, folder / "trajectories.png")
    if run.threat is not None:
        bar("figures", 1, 2, "threat maps")
        draw_maps(run)
    bar("figures", 2, 2, "")
    shared.animation(run, rooms[0], episodes[0], bar)


def scene_of(state: point_gather.State):
    """The room, with rings about its objects within which they are collected."""
    side = np.linspace(-point_gather.ROOM, point_gather.ROOM, 121)
    edge = np.full_like(side, point_gather.ROOM)
    walls = [np.stack(pair, axis=-1) for pair in ((side, edge), (side, -edge))]
    walls += [wall[:, ::-1] for wall in walls]
    apples, bombs = np.asarray(state.apples.position), np.asarray(state.bombs.position)
    return scenes.Scene(
        np.concatenate(walls),
        radius=0.2,
        colours=[scenes.GOOD] * len(apples) + [scenes.BAD] * len(bombs),
        rings=[
            (apples, point_gather.REACH, scenes.GOOD),
            (bombs, point_gather.REACH, scenes.BAD),
        ],
        names={scenes.GOOD: "apple, and its reach", scenes.BAD: "bomb, and its reach"},
    )


def objects_left(states: point_gather.State) -> Vehicle:
    """Apples, then bombs, those that have been collected at nan, which is not drawn."""
    both = (states.apples, states.bombs)
    position = np.concatenate(
        [np.where(o.present[..., None], o.position, np.nan) for o in both], axis=-2
    )
    return states.body.replace(position=position, heading=np.full_like(position, np.nan))


def draw_maps(run: RunResult) -> None:
    """The threat of one bomb in the middle of the room and before a wall, and of all bombs."""
    centres = [(0.0, 0.0), (-5.0, 0.0), (5.0, 0.0)]  # of the room, as the agent sees it
    places = ("in the middle of the room", "before a wall", "with its back to a wall")
    titles = [f"Agent {place}" for place in places]

    def features(places: np.ndarray, i: int) -> np.ndarray:
        return np.concatenate([places, np.tile([*centres[i], 1.0, 0.0], (len(places), 1))], axis=-1)

    panels = shared.threat_of_one(run, "bomb", titles, features)

    def outline(axis, i: int) -> None:
        corners = np.asarray([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
        axis.autoscale(False)
        axis.plot(*(centres[i] + point_gather.ROOM * corners).T, color="#38a169", label="wall")

    maps.heat_maps(panels, run.config.x, shared.figures_of(run) / "threat_of_one_bomb.png", outline)
    key = shared.key_of_figures(run, Stream.STARTS)
    state = point_gather.reset(key, run.agents.pmdp.params)
    box = (-point_gather.ROOM, point_gather.ROOM) * 2
    velocities = {"Agent heading along x": (0.0, 0.0), "Agent heading along y": (np.pi / 2, 0.0)}
    sums = shared.threat_of_all(run, state, box, velocities)

    def decorate(axis, i: int) -> None:
        bombs = np.asarray(state.bombs.position)
        axis.plot(*bombs.T, "o", color=scenes.BAD, markersize=4, label="bomb")

    maps.heat_maps(sums, run.config.x, shared.figures_of(run) / "threat_of_all.png", decorate)
