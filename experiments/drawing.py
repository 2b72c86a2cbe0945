"""Figures that all tasks share, from a finished run."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.pipeline import Finished
from experiments.tasks import MEDIA, key_of
from rp_jax import evaluate
from rp_jax.kinematics import Vehicle, make_vehicle
from rp_jax.planning import loop
from rp_jax.planning.pmdp import PMDP, Percept
from rp_jax.plot import curves, maps, scenes
from rp_jax.threat.report import predict


def curves_of(run: Finished) -> None:
    """learning_curves.png and threat_fit.png."""
    name = f"{run.task.name}: {run.rows[0]['method']}"
    curves.learning_curves(run.trained.history, name, run.folder / "learning_curves.png")
    if run.curves:
        curves.fit_curves(run.curves, run.folder / "threat_fit.png")


def play(
    run: Finished, params: Any, starts: Any, steps: int, obstacles: Callable[[Any], Vehicle] | None
) -> list[scenes.Episode]:
    """Episodes of the first seed's policy from given states (n,)."""
    pmdp = run.pmdp.replace(params=params)
    network = loop.make_network(run.config.planning, pmdp)
    weights = jax.tree.map(lambda a: a[0], run.trained.params)
    key = key_of(run.config.seed, MEDIA)
    return recorded(
        key,
        pmdp,
        starts,
        steps,
        functools.partial(evaluate.action_values, network),
        weights,
        obstacles,
    )


def recorded(
    key: jax.Array,
    pmdp: PMDP,
    starts: Any,
    steps: int,
    values: Callable[[Any], Callable[[Percept], jax.Array]],
    weights: Any,
    obstacles: Callable[[Any], Vehicle] | None = None,
) -> list[scenes.Episode]:
    """Episodes of any policy.

    Args:
        key: of the environment's randomness.
        pmdp: the environment, and what is admissible.
        starts: states (n,).
        steps: of an episode, at most.
        values: from `weights` to scores of the actions.
        weights: a pytree of arrays.
        obstacles: finds what else is drawn in a batch of states.
    """
    # One row more than steps, so that the state after the last one is seen too.
    rows = steps + 1

    @jax.jit
    def go(key, pmdp, weights, starts):
        return evaluate.record(key, pmdp, values(weights), starts, rows)

    shown = jax.tree.map(np.asarray, go(key, pmdp, weights, starts))
    count = shown.alive.shape[1]
    empty = np.zeros((rows, count, 0, 2))
    others = obstacles(shown.states) if obstacles else None
    over_episodes = jax.vmap(pmdp.env.causes, (0, None))
    causes = jax.jit(jax.vmap(over_episodes, (0, None)))(shown.states, pmdp.params)
    hit = np.any(list(causes.values()), axis=0)
    episodes = []
    for i in range(count):
        # The state after the last step stands in the row after it.
        end = min(int(shown.alive[:, i].sum()), steps) + 1
        at = lambda a, i=i, end=end: np.asarray(a)[:end, i]  # noqa: E731
        episodes.append(
            scenes.Episode(
                position=at(shown.states.agent.position),
                heading=at(shown.states.agent.heading),
                obstacles=at(others.position if others is not None else empty),
                obstacle_headings=at(others.heading if others is not None else empty),
                action=at(shown.action),
                threat=at(shown.threat),
                admissible=at(shown.admissible),
                secure=at(shown.secure),
                hit=at(hit),
            )
        )
    return episodes


def threat_of_one(
    run: Finished, kind: str, titles: Sequence[str], make: Callable[[np.ndarray, int], Any]
) -> list[maps.Panel]:
    """Least threat over the actions of one hazard at each place of its window (figure 4b).

    Args:
        run: the finished run.
        kind: of hazard.
        titles: of the panels.
        make: maps relative positions (n, 2) and the panel's number to features (n, F).
    """
    assert run.pmdp.threats is not None
    model = run.pmdp.threats[kind]
    low, high = np.asarray(model.source.window.lower), np.asarray(model.source.window.upper)
    xs, ys = np.linspace(low[0], high[0], 161), np.linspace(low[1], high[1], 121)
    grid = np.stack(np.meshgrid(xs, ys), axis=-1)
    panels = []
    for i, title in enumerate(titles):
        features = jnp.asarray(make(grid.reshape(-1, 2), i), jnp.float32)
        threat = np.asarray(predict(model, features)).min(axis=-1)
        extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
        panels.append(maps.Panel(title, threat.reshape(grid.shape[:2]), extent))
    return panels


def threat_of_all(
    run: Finished,
    state: Any,
    box: tuple[float, float, float, float],
    velocities: Mapping[str, tuple[float, float]],
    cells: int = 150,
) -> list[maps.Panel]:
    """Least total threat over the actions with the agent at each place (figures 4c and 4d).

    Args:
        run: the finished run.
        state: unbatched; all but the agent is taken from it.
        box: left, right, bottom, top of the places.
        velocities: by title, (heading, speed) of the agent.
        cells: places along the longer side.
    """
    left, right, bottom, top = box
    step = max(right - left, top - bottom) / cells
    xs, ys = np.arange(left, right, step), np.arange(bottom, top, step)
    grid = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    row = jax.jit(lambda pmdp, states: pmdp.threat(states).min(axis=-1))
    panels = []
    for title, (heading, speed) in velocities.items():
        parts = []
        for chunk in np.array_split(grid, -(-len(grid) // 512)):
            places = np.concatenate([chunk, np.repeat(chunk[-1:], 512 - len(chunk), axis=0)])
            agents = jax.vmap(make_vehicle, (0, None, None))(jnp.asarray(places), heading, speed)
            states = jax.tree.map(lambda a: jnp.broadcast_to(a, (512, *a.shape)), state)
            parts.append(np.asarray(row(run.pmdp, states.replace(agent=agents)))[: len(chunk)])
        threat = np.concatenate(parts).reshape(len(ys), len(xs))
        panels.append(maps.Panel(title, threat, box))
    return panels


def wall_maps(run: Finished, speeds: Sequence[float]) -> None:
    """threat_of_one_wall_point.png, the agent at several speeds; not where walls are joint."""
    if "wall" not in (run.pmdp.threats or {}):
        return
    panels = threat_of_one(
        run,
        "wall",
        [f"wall point, agent at {speed:g}" for speed in speeds],
        lambda places, i: np.concatenate([places, np.full((len(places), 1), speeds[i])], axis=-1),
    )
    maps.heat_maps(panels, run.config.x, run.folder / "threat_of_one_wall_point.png")


def animation(run: Finished, scene: scenes.Scene, episode: scenes.Episode) -> None:
    """animation.gif, beside the folder of figures."""
    env: Any = run.task.env
    scenes.animate(
        scene,
        episode,
        env.ACCELERATIONS,
        env.TURNS,
        run.config.x,
        run.folder.parent / "animation.gif",
        lambda done, total: run.bar("animation", done, total),
        "acceleration" if run.pmdp.params.agent.delayed else "step forward",
    )
