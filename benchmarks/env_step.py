"""Environment steps per second, automatic resets included, with and without observations."""

from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.measure import Row, main, measure
from rp_jax.envs import base, circuit, jam, point_gather

STEPS = 100


def steps(env, observed: bool):
    """A program of STEPS random actions in every environment of a batch."""

    def program(states, key, params):
        def step(carry, key):
            states, total = carry
            batch = total.shape[0]
            pick, move = jax.random.split(key)
            action = jax.random.randint(pick, (batch,), 0, env.num_actions(params))
            keys = jax.random.split(move, batch)
            states, _, outcome = base.auto_reset_step(env, keys, states, action, params)
            total = total + outcome.reward
            if observed:
                total = total + jax.vmap(env.observe, (0, None))(states, params).sum(axis=-1)
            return (states, total), None

        begin = (states, jnp.zeros(states.time.shape[0]))
        return jax.lax.scan(step, begin, jax.random.split(key, STEPS))[0]

    return program


def run(batch: int = 1024) -> list[Row]:
    """Circuit, Point Gather, and Jam among 3, 8, 15 and 50 obstacles."""
    cases: list[tuple[str, Any, Any]] = [("circuit", circuit, circuit.make_params())]
    cases.append(("point_gather", point_gather, point_gather.make_params()))
    cases += [(f"jam N={n}", jam, jam.make_params(n)) for n in (3, 8, 15, 50)]
    rows = []
    for name, env, params in cases:
        key = jax.random.key(0)
        states = jax.vmap(env.reset, (0, None))(jax.random.split(key, batch), params)
        for observed in (False, True):
            title = f"{name}, observed" if observed else name
            program = steps(env, observed)
            rows.append(measure(title, "steps", batch, batch * STEPS, program, states, key, params))
    return rows


if __name__ == "__main__":
    main("env_step", run)
