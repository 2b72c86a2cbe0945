"""Agent steps per second of the whole training loop."""

import jax

from benchmarks.measure import Row, main, measure
from benchmarks.setups import pmdp_of, tasks
from rp_jax.planning import loop

ITERATIONS = 100


def run() -> list[Row]:
    """Acting, environment, observation, threat, replay and learning, tuned recipe."""
    rows = []
    for name, (task, config) in tasks().items():
        pmdp, planning = pmdp_of(task, config), config.planning
        state, _ = jax.jit(loop.init, static_argnums=2)(jax.random.key(0), pmdp, planning)

        def program(state, pmdp, planning=planning):
            return loop.chunk(state, pmdp, planning, ITERATIONS)

        count = ITERATIONS * planning.num_envs
        title = f"{name}, {planning.samples_per_step:g} samples a step"
        rows.append(
            measure(title, "steps", planning.num_envs, count, program, state, pmdp, carried=True)
        )
    return rows


if __name__ == "__main__":
    main("train_step", run)
