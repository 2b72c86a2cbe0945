"""Point Gather (figure 5a): apples and bombs; a crash is an episode with at least one bomb.

python -m experiments.point_gather --preset quick
"""

import dataclasses
from dataclasses import dataclass, field

import jax
import numpy as np

from experiments import cli, pipeline, recipes, tasks
from rp_jax.envs import point_gather
from rp_jax.kinematics import Vehicle
from rp_jax.planning.loop import LoopConfig
from rp_jax.threat.build import ThreatConfig
from rp_jax.validate import one_of, within

ROOMS = 6  # in the figure of trajectories


@dataclass(frozen=True)
class Config(tasks.Config):
    """Settings of Point Gather."""

    apples: int = 2  # in a room
    bombs: int = 8  # in a room, while learning
    test_bombs: tuple[int, ...] = (8, 16)  # while testing
    horizon: int = 5  # steps after which the threat of a bomb is cut
    bomb: ThreatConfig = field(default_factory=lambda: recipes.TUNED_BOMB)  # of a bomb


def quick(recipe: str) -> Config:
    """Minutes on two cores."""
    config = Config(x=0.5, penalty=1.0, planning=LoopConfig(steps=1_200_000), episodes=10_000)
    return paper(config) if recipe == "paper" else config


def full(recipe: str) -> Config:
    """What committed results are made with."""
    return dataclasses.replace(quick(recipe), seeds=10 if recipe == "tuned" else 1, episodes=20_000)


def paper(config: Config) -> Config:
    """The paper's architectures and hyperparameters (appendix G.1)."""
    return dataclasses.replace(config, bomb=recipes.PAPER_BOMB, planning=recipes.PAPER_PLANNING)


def make_task(config: Config) -> tasks.Task:
    """Environments and threats, checked."""
    one_of("baseline", config.baseline, ["paper"])
    if not config.test_bombs:
        raise ValueError("test_bombs is (); it must name at least one count")

    def params(bombs: int) -> point_gather.Params:
        return point_gather.make_params(
            config.apples, bombs, horizon=config.horizon, fidelity=config.fidelity
        )

    train = params(config.bombs)
    with within("test_bombs"):
        tests = {f"{n} bombs": params(n) for n in config.test_bombs}
    return tasks.Task(
        name="point_gather",
        env=point_gather,
        train=train,
        tests=tests,
        threats={"bomb": config.bomb},
        draw=draw,
    )


def draw(run: pipeline.Finished) -> None:
    """All figures of a run, and an animation."""
    from experiments import drawing
    from rp_jax.plot import scenes

    bar, folder, params = run.bar, run.folder, run.pmdp.params
    bar("still", 0, 3, "curves")
    drawing.curves_of(run)
    bar("still", 1, 3, "trajectories")
    keys = jax.random.split(tasks.key_of(run.config.seed, tasks.STARTS), ROOMS)
    starts = jax.vmap(point_gather.reset, (0, None))(keys, params)
    episodes = drawing.play(run, params, starts, int(params.time_limit), objects_left)
    rooms = [scene_of(jax.tree.map(lambda a, i=i: a[i], starts)) for i in range(ROOMS)]
    panels = [(f"room {i}", rooms[i], [episodes[i]]) for i in range(ROOMS)]
    scenes.trajectories(panels, folder / "trajectories.png")
    if run.pmdp.threats is not None:
        bar("still", 2, 3, "threat maps")
        draw_maps(run)
    bar("still", 3, 3)
    drawing.animation(run, rooms[0], episodes[0])


def scene_of(state: point_gather.State):
    """The room, with rings about its objects within which they are collected."""
    from rp_jax.plot import scenes

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
    )


def objects_left(states: point_gather.State) -> Vehicle:
    """Apples, then bombs, those that have been collected at nan, which is not drawn."""
    both = (states.apples, states.bombs)
    position = np.concatenate(
        [np.where(o.present[..., None], o.position, np.nan) for o in both], axis=-2
    )
    return states.agent.replace(position=position, heading=np.full_like(position, np.nan))


def draw_maps(run: pipeline.Finished) -> None:
    """The threat of one bomb in the middle of the room and before a wall, and of all bombs."""
    from experiments import drawing
    from rp_jax.plot import maps, scenes

    centres = [(0.0, 0.0), (-5.0, 0.0), (5.0, 0.0)]  # of the room, as the agent sees it
    titles = ["in the middle", "a wall ahead", "a wall behind"]

    def features(places: np.ndarray, i: int) -> np.ndarray:
        return np.concatenate([places, np.tile([*centres[i], 1.0, 0.0], (len(places), 1))], axis=-1)

    panels = drawing.threat_of_one(run, "bomb", titles, features)

    def outline(axis, i: int) -> None:
        corners = np.asarray([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
        axis.autoscale(False)
        axis.plot(*(centres[i] + point_gather.ROOM * corners).T, "w")

    maps.heat_maps(panels, run.config.x, run.folder / "threat_of_one_bomb.png", outline)
    key = tasks.key_of(run.config.seed, tasks.STARTS)
    state = point_gather.reset(key, run.pmdp.params)
    box = (-point_gather.ROOM, point_gather.ROOM) * 2
    velocities = {"heading 0 deg": (0.0, 0.0), "heading 90 deg": (np.pi / 2, 0.0)}
    sums = drawing.threat_of_all(run, state, box, velocities)

    def decorate(axis, i: int) -> None:
        axis.plot(*np.asarray(state.bombs.position).T, "o", color=scenes.BAD, markersize=4)

    maps.heat_maps(sums, run.config.x, run.folder / "threat_of_all.png", decorate)


PRESETS = {"quick": quick, "full": full}

if __name__ == "__main__":
    cli.main("experiments.point_gather", __doc__ or "", PRESETS, make_task)
