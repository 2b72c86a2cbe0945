"""Environment steps per second, automatic resets included, with and without observations."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.bound import Piece
from benchmarks.measure import Row, measure
from benchmarks.report import main
from rp_jax.envs import autoreset, circuit, jam, optional, point_gather

STEPS = 100
BATCH = 1024
BATCHES = (1, 16, 256, 4096, 16_384)  # beside BATCH
SWEPT = ("circuit", "jam N=8")  # over all batches
MOST = 200_000  # environment steps of a call, so that large batches do not take longer


def steps(env, observed: bool, turns: int = STEPS):
    """A program of so many random actions in every environment of a batch."""

    def program(states, key, params):
        def step(carry, key):
            states, total = carry
            batch = total.shape[0]
            pick, move = jax.random.split(key)
            action = jax.random.randint(pick, (batch,), 0, optional.num_actions(env, params))
            keys = jax.random.split(move, batch)
            states, _, outcome = autoreset.auto_reset_step(env, keys, states, action, params)
            total = total + outcome.reward
            if observed:
                total = total + jax.vmap(env.observe, (0, None))(states, params).sum(axis=-1)
            return (states, total), None

        begin = (states, jnp.zeros(states.time.shape[0]))
        return jax.lax.scan(step, begin, jax.random.split(key, turns))[0]

    return program


def row(name: str, env: Any, params: Any, observed: bool, batch: int) -> Row:
    """One environment at one batch size."""
    key = jax.random.key(0)
    states = jax.vmap(env.reset, (0, None))(jax.random.split(key, batch), params)
    made = (states, key, params)
    turns = max(1, min(STEPS, MOST // batch))
    pieces = [Piece(steps(env, observed, 1), made, turns)]
    title = f"{name}, observed" if observed else name
    program = steps(env, observed, turns)
    return measure(title, "steps", batch, batch * turns, program, *made, pieces=pieces)


def cases() -> dict[str, tuple[Any, Any]]:
    """Circuit, Jam among 3, 8, 15 and 50 obstacles, and Point Gather: modules and parameters."""
    found: dict[str, tuple[Any, Any]] = {"circuit": (circuit, circuit.make_params())}
    found |= {f"jam N={n}": (jam, jam.make_params(n)) for n in (3, 8, 15, 50)}
    return found | {"point gather": (point_gather, point_gather.make_params())}


def run(batch: int = BATCH, batches: Sequence[int] = BATCHES) -> list[Row]:
    """All of them at one batch size, with and without observations; two at all sizes."""
    found = cases()
    rows = [row(name, *case, look, batch) for name, case in found.items() for look in (False, True)]
    return rows + [row(name, *found[name], True, b) for name in SWEPT for b in batches]


if __name__ == "__main__":
    main("env_step", run)
