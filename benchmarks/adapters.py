"""gymnasium's vector environment against the jitted step that it calls, both from Python."""

import itertools
import time
from collections.abc import Callable, Sequence

import jax
import numpy as np

from benchmarks.measure import Row, row_of
from benchmarks.report import main
from rp_jax.adapters import registry
from rp_jax.envs import autoreset, optional

STEPS, REPEATS = 10, 40


def raw(name: str, batch: int) -> Callable[[np.ndarray], None]:
    """Returns a step with observations and fresh starts, and nothing else."""
    env, params = registry.make(name)
    look = lambda states: jax.vmap(env.observe, (0, None))(states, params)  # noqa: E731

    @jax.jit
    def advance(key, states, actions, params):
        key, now = jax.random.split(key)
        keys = jax.random.split(now, batch)
        return key, autoreset.step_and_renew(env, keys, states, actions, params, look)

    keys = jax.random.split(jax.random.key(0), batch)
    carry = [jax.random.key(1), jax.vmap(env.reset, (0, None))(keys, params)]

    def step(actions: np.ndarray) -> None:
        key, result = jax.block_until_ready(advance(*carry, actions, params))
        carry[:] = key, result[0][0]

    return step


def adapted(name: str, batch: int) -> Callable[[np.ndarray], None]:
    """Returns the step through gymnasium."""
    from rp_jax.adapters.gymnasium import JaxVectorEnv

    env = JaxVectorEnv(name, batch)
    env.reset(seed=0)

    def step(actions: np.ndarray) -> None:
        env.step(actions)

    return step


def alternated(steps: Sequence[Callable], actions: Sequence[np.ndarray]) -> list[list[float]]:
    """Calls per second of each, by turns, so that a busy machine slows both alike."""
    rates: list[list[float]] = [[] for _ in steps]
    for _, (step, found) in itertools.product(range(REPEATS + 1), zip(steps, rates, strict=True)):
        began = time.perf_counter()
        for action in actions:
            step(action)
        found.append(len(actions) / (time.perf_counter() - began))
    return [found[1:] for found in rates]  # the first ones compile and warm up


def run(batch: int = 1024) -> list[Row]:
    """Environment steps per second, and how much of the raw step's rate is left."""
    rows = []
    for name in ("circuit", "jam"):
        env, params = registry.make(name)
        draws = jax.random.randint(
            jax.random.key(0), (STEPS, batch), 0, optional.num_actions(env, params)
        )
        actions = list(np.asarray(draws))
        rates = alternated([raw(name, batch), adapted(name, batch)], actions)
        shares = [after / before for before, after in zip(*rates, strict=True)]
        raw_steps, adapted_steps = ([batch * rate for rate in found] for found in rates)
        rows += [
            row_of(f"{name}, raw step", "steps", batch, raw_steps),
            row_of(f"{name}, gymnasium", "steps", batch, adapted_steps),
            row_of(f"{name}, gymnasium / raw", "ratio", batch, shares),
        ]
    return rows


if __name__ == "__main__":
    main("adapters", run)
