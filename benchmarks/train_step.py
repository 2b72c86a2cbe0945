"""Agent steps per second of the whole training loop."""

import jax

from benchmarks.bound import Piece
from benchmarks.measure import Row, measure, recount
from benchmarks.report import main
from benchmarks.setups import more_chunks, pmdp_of, quick_tasks
from rp_jax.planning import loop
from rp_jax.planning.loop import LoopConfig
from rp_jax.planning.pmdp import PMDP

ITERATIONS = 100


def row(title: str, pmdp: PMDP, planning: LoopConfig) -> Row:
    """The loop with the settings `planning`."""
    state, _ = jax.jit(loop.init, static_argnums=2)(jax.random.key(0), pmdp, planning)

    def program(state, pmdp, iterations=ITERATIONS):
        return loop.chunk(state, pmdp, planning, iterations)

    one = Piece(lambda state, pmdp: program(state, pmdp, 1), (state, pmdp), ITERATIONS)
    pieces = [one, *more_chunks(pmdp, state.states, ITERATIONS)]
    batch = planning.num_envs
    made = (program, state, pmdp)
    return measure(title, "steps", batch, ITERATIONS * batch, *made, carried=True, pieces=pieces)


def run() -> list[Row]:
    """Acting, environment, observation, threat, replay and learning, tuned recipe."""
    rows = []
    for name, (world, config) in quick_tasks().items():
        samples = config.planning.samples_per_step
        found = row(f"{name}, {samples:g} samples a step", pmdp_of(world, config), config.planning)
        rows += [found, recount(found, "samples", samples)]
    return rows


if __name__ == "__main__":
    main("train_step", run)
