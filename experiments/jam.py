"""Jam (figure 4, table 1): trained among 8 obstacles, tested among 3, 8 and 15.

python -m experiments.jam --preset quick
"""

import dataclasses
from dataclasses import dataclass, field

import jax
import numpy as np

from experiments import cli, pipeline, recipes, tasks
from rp_jax.envs import jam
from rp_jax.kinematics import Vehicle
from rp_jax.planning.loop import LoopConfig
from rp_jax.threat.build import ThreatConfig
from rp_jax.validate import within


@dataclass(frozen=True)
class Config(tasks.Config):
    """Settings of Jam."""

    obstacles: int = 8  # while learning
    fewest_obstacles: int | None = None  # so many to `obstacles` in each episode of learning
    test_obstacles: tuple[int, ...] = (3, 8, 15)  # while testing
    obstacle_horizon: int = 8  # steps after which the threat of an obstacle is cut
    wall: ThreatConfig = field(default_factory=lambda: recipes.TUNED_WALL)  # threat of a wall point
    obstacle: ThreatConfig = field(default_factory=lambda: recipes.TUNED_OBSTACLE)  # of an obstacle


def quick(recipe: str) -> Config:
    """Minutes on two cores."""
    config = Config(planning=LoopConfig(steps=1_200_000), episodes=10_000)
    return paper(config) if recipe == "paper" else config


def full(recipe: str) -> Config:
    """What committed results are made with."""
    return dataclasses.replace(quick(recipe), seeds=10 if recipe == "tuned" else 1, episodes=20_000)


def paper(config: Config) -> Config:
    """The paper's architectures and hyperparameters (appendix G.1)."""
    return dataclasses.replace(
        config,
        wall=recipes.PAPER_WALL,
        obstacle=recipes.PAPER_OBSTACLE,
        planning=recipes.PAPER_PLANNING,
    )


def make_task(config: Config) -> tasks.Task:
    """Environments and threats, checked."""
    if not config.test_obstacles:
        raise ValueError("test_obstacles is (); it must name at least one count")

    def params(n: int, fewest: int | None = None) -> jam.Params:
        return jam.make_params(
            n,
            fewest=fewest,
            obstacle_horizon=config.obstacle_horizon,
            fidelity=config.fidelity,
            baseline=config.baseline,
        )

    train = params(config.obstacles, config.fewest_obstacles)
    with within("test_obstacles"):
        tests = {f"N={n}": params(n) for n in config.test_obstacles}
    return tasks.Task(
        name="jam",
        env=jam,
        train=train,
        tests=tests,
        threats={"wall": config.wall, "obstacle": config.obstacle},
        draw=draw,
    )


def draw(run: pipeline.Finished) -> None:
    """All figures of a run, and an animation."""
    from experiments import drawing
    from rp_jax.plot import scenes

    bar, folder = run.bar, run.folder
    bar("still", 0, 3, "curves")
    drawing.curves_of(run)
    corners = [(0.0, 0.0), (0.0, jam.ROOM), (jam.ROOM, 0.0)]
    scene = scenes.Scene(jam.wall_points(), corners, jam.ZONE, run.config.fidelity == "paper")
    bar("still", 1, 3, "trajectories")
    panels = []
    for variant, test in run.task.tests.items():
        keys = jax.random.split(tasks.key_of(run.config.seed, tasks.STARTS), 20)
        starts = jax.vmap(jam.reset, (0, None))(keys, test)
        limit = int(test.time_limit)
        episodes = drawing.play(run, test, starts, limit, present_obstacles)
        panels.append((variant, scene, episodes))
        if variant == f"N={run.config.obstacles}" or len(panels) == 1:
            shown = episodes
    scenes.trajectories(panels, folder / "trajectories.png")
    if run.pmdp.threats is not None:
        bar("still", 2, 3, "threat maps")
        draw_maps(run)
    bar("still", 3, 3)
    ended = [e for e in shown if len(e.action) < limit] or shown
    longest = max(ended, key=lambda e: len(e.action))
    drawing.animation(run, scene, longest)


def present_obstacles(states: jam.State) -> Vehicle:
    """The obstacles, those that have disappeared at nan, which is not drawn."""
    shown = states.present[..., None]
    position = np.where(shown, states.obstacles.position, np.nan)
    return states.obstacles.replace(position=position)


def draw_maps(run: pipeline.Finished) -> None:
    """Figure 4: single-obstacle threats, and their sums for two velocities."""
    from experiments import drawing
    from rp_jax.plot import maps

    cases = [(0.0, 0.06, 0.1), (np.pi, 0.06, 0.1), (np.pi / 2, 0.06, 0.0)]
    titles = [
        f"obstacle heading {np.degrees(h):.0f} deg at {v:g}, agent at {own:g}"
        for h, v, own in cases
    ]

    def features(places: np.ndarray, i: int) -> np.ndarray:
        heading, speed, own = cases[i]
        rest = [np.cos(heading), np.sin(heading), speed, own]
        return np.concatenate([places, np.tile(rest, (len(places), 1))], axis=-1)

    panels = drawing.threat_of_one(run, "obstacle", titles, features)
    maps.heat_maps(panels, run.config.x, run.folder / "threat_of_one_obstacle.png")
    drawing.wall_maps(run, (0.1, 0.0, -0.1))
    key = tasks.key_of(run.config.seed, tasks.STARTS)
    state = jam.reset(key, run.pmdp.params)
    velocities = {
        "heading 45 deg, speed 0.1": (np.pi / 4, 0.1),
        "heading 180 deg, speed 0.05": (np.pi, 0.05),
    }
    sums = drawing.threat_of_all(run, state, (0.0, 3.0, 0.0, 3.0), velocities)
    others = jax.tree.map(np.asarray, state.obstacles)

    def decorate(axis, i: int) -> None:
        axis.quiver(
            *others.position.T, *(others.heading * others.speed[:, None]).T, color="#63b3ed"
        )
        axis.plot(*others.position.T, "o", color="#63b3ed", markersize=4)
        axis.plot(*jam.wall_points().T, ",", color="white")

    maps.heat_maps(sums, run.config.x, run.folder / "threat_of_all.png", decorate)


PRESETS = {"quick": quick, "full": full}

if __name__ == "__main__":
    cli.main("experiments.jam", __doc__ or "", PRESETS, make_task)
