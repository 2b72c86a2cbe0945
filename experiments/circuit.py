"""Circuit (figure 6, table 2): trained on one track, tested on it, narrowed, and on a circle.

python -m experiments.circuit --preset quick
"""

import dataclasses
from dataclasses import dataclass, field

import jax
import numpy as np

from experiments import cli, pipeline, recipes, tasks
from rp_jax.envs import circuit
from rp_jax.planning.loop import LoopConfig
from rp_jax.threat.build import ThreatConfig
from rp_jax.validate import number, within


@dataclass(frozen=True)
class Config(tasks.Config):
    """Settings of Circuit."""

    track: str = "default"  # while learning: default, narrowed or circle
    test_tracks: tuple[str, ...] = ("default", "narrowed", "circle")  # while testing
    wall: ThreatConfig = field(default_factory=lambda: recipes.TUNED_WALL)  # of a wall point
    lost: float = 0.0  # share of learning episodes in which the agent is not told where it is

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        super().validate()
        number("lost", self.lost, least=0, most=1)


def quick(recipe: str) -> Config:
    """Minutes on two cores."""
    config = Config(x=0.001, penalty=200.0, planning=LoopConfig(steps=1_800_000), episodes=10_000)
    return paper(config) if recipe == "paper" else config


def full(recipe: str) -> Config:
    """What committed results are made with."""
    return dataclasses.replace(quick(recipe), seeds=10 if recipe == "tuned" else 1, episodes=20_000)


def paper(config: Config) -> Config:
    """The paper's architectures and hyperparameters (appendix G.1)."""
    return dataclasses.replace(config, wall=recipes.PAPER_WALL, planning=recipes.PAPER_PLANNING)


def make_task(config: Config) -> tasks.Task:
    """Environments and threats, checked.

    An agent that learned to do without x and y is not told them where the track leads elsewhere
    than the one that it learned on: what it knows of places is wrong there.
    """
    if not config.test_tracks:
        raise ValueError("test_tracks is (); it must name at least one track")

    def params(track: str, lost: float = 0.0) -> circuit.Params:
        return circuit.make_params(
            track, fidelity=config.fidelity, baseline=config.baseline, lost=lost
        )

    train = params(config.track, config.lost)

    def test(track: str) -> circuit.Params:
        found = params(track)
        elsewhere = not np.array_equal(found.track.centre, train.track.centre)
        return found.replace(lost=jax.numpy.asarray(elsewhere and config.lost > 0, float))

    with within("test_tracks"):
        tests = {track: test(track) for track in config.test_tracks}
    return tasks.Task(
        name="circuit",
        env=circuit,
        train=train,
        tests=tests,
        threats={"wall": config.wall},
        draw=draw,
    )


def draw(run: pipeline.Finished) -> None:
    """All figures of a run, and an animation."""
    from experiments import drawing
    from rp_jax.plot import scenes

    bar, folder = run.bar, run.folder
    bar("still", 0, 3, "curves")
    drawing.curves_of(run)
    bar("still", 1, 3, "trajectories")
    panels = []
    for variant, params in run.task.tests.items():
        demo = circuit.demo_start(params)
        keys = jax.random.split(tasks.key_of(run.config.seed, tasks.STARTS), 7)
        starts = jax.vmap(circuit.reset, (0, None))(keys, params)
        starts = jax.tree.map(lambda a, b: jax.numpy.concatenate([a[None], b]), demo, starts)
        episodes = drawing.play(run, params, starts, int(params.time_limit), None)
        panels.append((variant, scenes.Scene(np.asarray(params.track.walls)), episodes))
    scenes.trajectories(panels, folder / "trajectories.png")
    if run.pmdp.threats is not None:
        bar("still", 2, 3, "threat maps")
        draw_maps(run)
    bar("still", 3, 3)
    _, scene, episodes = panels[0]
    drawing.animation(run, scene, episodes[0])


def draw_maps(run: pipeline.Finished) -> None:
    """The threat of one wall point at three speeds, and of the whole track for two velocities."""
    from experiments import drawing
    from rp_jax.plot import maps

    drawing.wall_maps(run, (0.1, 0.04, -0.04))
    walls = np.asarray(run.pmdp.params.track.walls)
    (left, bottom), (right, top) = walls.min(axis=0) - 0.1, walls.max(axis=0) + 0.1
    velocities = {
        "heading 0 deg, speed 0.1": (0.0, 0.1),
        "heading 90 deg, speed 0.1": (np.pi / 2, 0.1),
    }
    state = circuit.demo_start(run.pmdp.params)
    sums = drawing.threat_of_all(run, state, (left, right, bottom, top), velocities)

    def decorate(axis, i: int) -> None:
        axis.plot(*walls.T, ",", color="white")

    maps.heat_maps(sums, run.config.x, run.folder / "threat_of_all.png", decorate)


PRESETS = {"quick": quick, "full": full}

if __name__ == "__main__":
    cli.main("experiments.circuit", __doc__ or "", PRESETS, make_task)
