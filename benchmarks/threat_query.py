"""Total threats per second, of states that exploration comes by."""

import jax

from benchmarks.bound import Piece
from benchmarks.measure import Row, measure, recount
from benchmarks.report import main
from benchmarks.setups import inside, more_chunks, pmdp_of, quick_tasks
from rp_jax import recording


def run(batches: tuple[int, ...] = (1, 16, 256, 4096, 16_384)) -> list[Row]:
    """States per second, all actions and all hazards of each, by batch.

    "pairs" are those of a state and a hazard in its reach; only they are shown to a network.
    """
    rows = []
    for name, (world, config) in quick_tasks().items():
        pmdp = pmdp_of(world, config)
        for batch in batches:
            states = jax.jit(recording.visited_states, static_argnums=2)(
                jax.random.key(0), pmdp, batch
            )
            program = lambda pmdp, states: pmdp.threat(states)  # noqa: E731
            made = (pmdp, states)
            pieces = [Piece(program, made), *more_chunks(pmdp, states)]
            row = measure(name, "states", batch, batch, program, *made, repeats=20, pieces=pieces)
            pairs = sum(inside(pmdp, states).values())
            rows += [row, recount(row, "pairs", max(1, pairs) / batch)]
    return rows


if __name__ == "__main__":
    main("threat_query", run)
