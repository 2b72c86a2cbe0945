"""Figures that all tasks of the paper share, from a finished run."""

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rp_jax import evaluation, recording
from rp_jax.dynamics import Vehicle, make_vehicle
from rp_jax.envs import optional
from rp_jax.planning.percept import Percept
from rp_jax.planning.pmdp import PMDP
from rp_jax.plot import maps, scenes
from rp_jax.runs.progress import OnProgress
from rp_jax.runs.train import RunResult
from rp_jax.streams import Stream, key_of
from rp_jax.threat.report import predict


def key_of_figures(run: RunResult, stream: Stream) -> jax.Array:
    """The key of what is drawn of a run."""
    return key_of(jax.random.key(run.config.seed), stream)


def play(
    run: RunResult, params: Any, starts: Any, steps: int, obstacles: Callable[[Any], Vehicle] | None
) -> list[scenes.Episode]:
    """Episodes of the first agent from given states (n,)."""
    agent = run.agents[0]
    return recorded(
        key_of_figures(run, Stream.RECORDING),
        agent.pmdp.replace(params=params),
        starts,
        steps,
        functools.partial(evaluation.action_values, agent.network),
        agent.weights,
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
        return recording.record(key, pmdp, values(weights), starts, rows)

    shown = jax.tree.map(np.asarray, go(key, pmdp, weights, starts))
    count = shown.alive.shape[1]
    empty = np.zeros((rows, count, 0, 2))
    others = obstacles(shown.states) if obstacles else None
    hits = functools.partial(optional.collisions, pmdp.env)
    over_episodes = jax.vmap(hits, (0, None))
    collisions = jax.jit(jax.vmap(over_episodes, (0, None)))(shown.states, pmdp.params)
    hit = np.any(list(collisions.values()), axis=0)
    episodes = []
    for i in range(count):
        # The state after the last step stands in the row after it.
        end = min(int(shown.alive[:, i].sum()), steps) + 1
        at = lambda a, i=i, end=end: np.asarray(a)[:end, i]  # noqa: E731
        episodes.append(
            scenes.Episode(
                position=at(shown.states.body.position),
                heading=at(shown.states.body.heading),
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
    run: RunResult, kind: str, titles: Sequence[str], make: Callable[[np.ndarray, int], Any]
) -> list[maps.Panel]:
    """Least threat over the actions of one hazard at each place of its window (figure 4b).

    Args:
        run: the finished run.
        kind: of hazard.
        titles: of the panels.
        make: maps relative positions (n, 2) and the panel's number to features (n, F).
    """
    model = run.agents.pmdp.threats[kind]
    low, high = np.asarray(model.source.window.lower), np.asarray(model.source.window.upper)
    xs, ys = np.linspace(low[0], high[0], 161), np.linspace(low[1], high[1], 121)
    grid = np.stack(np.meshgrid(xs, ys), axis=-1)
    panels = []
    for i, title in enumerate(titles):
        features = jnp.asarray(make(grid.reshape(-1, 2), i), jnp.float32)
        threat = np.asarray(predict(model, features)).min(axis=-1)
        extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
        labels = (f"{kind} ahead of the agent, room units", f"{kind} to its left, room units")
        panels.append(maps.Panel(title, threat.reshape(grid.shape[:2]), extent, *labels))
    return panels


def threat_of_all(
    run: RunResult,
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
            bodies = jax.vmap(make_vehicle, (0, None, None))(jnp.asarray(places), heading, speed)
            states = jax.tree.map(lambda a: jnp.broadcast_to(a, (512, *a.shape)), state)
            parts.append(
                np.asarray(row(run.agents[0].pmdp, states.replace(body=bodies)))[: len(chunk)]
            )
        threat = np.concatenate(parts).reshape(len(ys), len(xs))
        labels = ("x of the agent, room units", "y of the agent, room units")
        panels.append(maps.Panel(title, threat, box, *labels))
    return panels


def wall_maps(run: RunResult, speeds: Sequence[float]) -> None:
    """threat_of_one_wall_point.png, the agent at several speeds; not where walls are joint."""
    if "wall" not in run.agents.pmdp.threats:
        return
    panels = threat_of_one(
        run,
        "wall",
        [f"One wall point, agent at {speed:g} room units / step" for speed in speeds],
        lambda places, i: np.concatenate([places, np.full((len(places), 1), speeds[i])], axis=-1),
    )
    maps.heat_maps(panels, run.config.x, figures_of(run) / "threat_of_one_wall_point.png")


def animation(
    run: RunResult, scene: scenes.Scene, episode: scenes.Episode, bar: OnProgress
) -> None:
    """animation.gif, beside the folder of figures."""
    env: Any = run.world.env
    scenes.animate(
        scene,
        episode,
        env.ACCELERATIONS,
        env.TURNS,
        run.config.x,
        run.folder / "animation.gif",
        lambda done, total: bar("animation", done, total, ""),
        "acceleration, room units / step$^2$"
        if run.agents.pmdp.params.body.delayed
        else "step forward, room units",
    )


def figures_of(run: RunResult) -> Path:
    """The folder for figures."""
    return run.folder / "figures"
