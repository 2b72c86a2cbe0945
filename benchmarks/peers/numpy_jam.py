"""Jam in plain NumPy, one environment at a time: the floor that a step is compared with.

A second copy of the dynamics, on purpose; it holds for `fidelity="released"` and at least 8
obstacles, and is tested against `rp_jax.envs.jam` transition for transition.
"""

import time
from typing import NamedTuple

import numpy as np

from benchmarks.measure import Row, row_of
from rp_jax.envs import jam

POINTS = jam.wall_points()
GOAL = np.array([2.6, 3.0])
CORNERS = np.array([[0.0, 0.0], [0.0, jam.ROOM], [jam.ROOM, 0.0]])
RADIUS = 0.1
TIME_LIMIT = 100
STEPS, REPEATS = 500, 5
X, Y, ANGLE, SPEED = range(4)  # columns of a vehicle


class State(NamedTuple):
    """Agent and obstacles."""

    body: np.ndarray  # (4,) x, y, heading in radians, speed
    obstacles: np.ndarray  # (N, 4) likewise
    progress: float  # -20 x distance to the goal, rounded
    time: int


class Step(NamedTuple):
    """The result of a step."""

    state: State
    reward: float
    crashed: bool
    goal: bool
    done: bool


def _advanced(vehicle: np.ndarray, drive: np.ndarray, low: float, high: float) -> np.ndarray:
    """Vehicles (..., 4) after accelerations and turns (..., 2)."""
    x, y, angle, speed = np.moveaxis(vehicle, -1, 0)
    moved = x + np.cos(angle) * speed, y + np.sin(angle) * speed
    changed = angle + drive[..., 1], np.clip(speed + drive[..., 0], low, high)
    return np.stack([*moved, *changed], axis=-1)


def _progress(body: np.ndarray) -> float:
    return float(np.round(-20 * np.hypot(*(GOAL - body[:2]))))


def _gone(obstacles: np.ndarray) -> np.ndarray:
    """(N,) bool: outside the room, or in a corner that is a safety zone."""
    place = obstacles[:, :2]
    outside = ((place <= RADIUS) | (place >= jam.ROOM - RADIUS)).any(axis=-1)
    zones = (np.abs(place[:, None] - CORNERS) < jam.ZONE).all(axis=-1)
    return outside | zones.any(axis=-1)


def _appear(rng: np.random.Generator, body: np.ndarray) -> np.ndarray:
    """(4,) an obstacle away from the agent."""
    while True:
        place = rng.uniform(RADIUS, jam.ROOM - RADIUS, 2)
        if np.hypot(*(place - body[:2])) >= jam.CLEARANCE:
            heading, speed = rng.uniform(-np.pi, np.pi), rng.choice(jam.OBSTACLE_SPEEDS)
            return np.array([*place, heading, speed])


def reset(rng: np.random.Generator, obstacles: int = 8) -> State:
    """The agent in its corner, the obstacles away from it."""
    body = np.array([0.2, 0.2, 0.0, 0.0])
    others = np.stack([_appear(rng, body) for _ in range(obstacles)])
    return State(body, others, _progress(body), 0)


def move(state: State, action: int, drive: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Agent (4,), obstacles (N, 4) under accelerations and turns (N, 2), those out of place."""
    own = jam.ACCELERATIONS[action // len(jam.TURNS)], jam.TURNS[action % len(jam.TURNS)]
    body = _advanced(state.body, np.array(own), jam.SPEEDS[0], jam.SPEEDS[-1])
    ends = jam.OBSTACLE_SPEEDS[0], jam.OBSTACLE_SPEEDS[-1]
    obstacles = _advanced(state.obstacles, drive, *ends)
    return body, obstacles, _gone(obstacles)


def finished(state: State, body: np.ndarray, obstacles: np.ndarray) -> Step:
    """Reward and end of a step from `state` that led to these vehicles."""
    walls = np.hypot(*(POINTS - body[:2]).T) < RADIUS
    others = np.hypot(*(obstacles[:, :2] - body[:2]).T) < 2 * RADIUS
    crashed = bool(walls.any() or others.any())
    goal = bool(body[Y] > jam.ROOM)
    reached = State(body, obstacles, _progress(body), state.time + 1)
    slow = 0.05 * (abs(body[SPEED]) < 0.005)
    reward = reached.progress - state.progress - 0.05 - slow + 10.0 * goal
    return Step(reached, reward, crashed, goal, crashed or goal or reached.time >= TIME_LIMIT)


def step(rng: np.random.Generator, state: State, action: int) -> Step:
    """One transition; obstacles out of place appear elsewhere."""
    count = len(state.obstacles)
    acceleration = rng.choice(jam.ACCELERATIONS, count, p=(0.2, 0.6, 0.2))
    drive = np.stack([acceleration, rng.choice(jam.OBSTACLE_TURNS, count)], axis=-1)
    body, obstacles, gone = move(state, action, drive)
    for n in np.flatnonzero(gone):
        obstacles[n] = _appear(rng, body)
    return finished(state, body, obstacles)


def observe(state: State) -> np.ndarray:
    """Returns the observation (396,): LIDAR of the walls (360), 8 obstacles (32), and the pose."""
    body = state.body
    offset = POINTS - body[:2]
    distance = np.hypot(*offset.T)
    near = distance < 1.0
    angle = np.arctan2(offset[near, 1], offset[near, 0]) - body[ANGLE]
    bins = np.floor((angle + np.pi) % (2 * np.pi) * (jam.LIDAR_BINS / (2 * np.pi))).astype(int)
    scan = np.full(jam.LIDAR_BINS, np.inf)
    np.minimum.at(scan, bins % jam.LIDAR_BINS, distance[near])
    scan[np.isinf(scan)] = 0.0
    pose = [body[X], body[Y], _wrapped(body[ANGLE]), body[SPEED]]
    return np.concatenate([scan, _seen(state).ravel(), pose])


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _seen(state: State) -> np.ndarray:
    """(8, 4) the nearest obstacles in the agent's frame."""
    body = state.body
    offset = state.obstacles[:, :2] - body[:2]
    order = np.argsort((offset**2).sum(axis=-1), kind="stable")[: jam.SEEN_OBSTACLES]
    (x, y), cos, sin = offset[order].T, np.cos(body[ANGLE]), np.sin(body[ANGLE])
    turn = _wrapped(state.obstacles[order, ANGLE] - body[ANGLE])
    speed = state.obstacles[order, SPEED]
    return np.stack([x * cos + y * sin, y * cos - x * sin, turn, speed], axis=-1)


def run() -> list[Row]:
    """Random actions, with and without observations."""
    rows = []
    for observed in (False, True):
        rng = np.random.default_rng(0)
        state, rates = reset(rng), []
        for _ in range(REPEATS):
            began = time.perf_counter()
            for _ in range(STEPS):
                found = step(rng, state, int(rng.integers(15)))
                state = reset(rng) if found.done else found.state
                if observed:
                    observe(state)
            rates.append(STEPS / (time.perf_counter() - began))
        title = "NumPy Jam, observed" if observed else "NumPy Jam"
        rows.append(row_of(title, "environment steps", 1, rates))
    return rows
