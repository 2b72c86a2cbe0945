"""Agent steps per second of training runs side by side, of all of them together."""

import jax

from benchmarks.bound import Piece
from benchmarks.measure import Row, measure
from benchmarks.report import main
from benchmarks.setups import more_chunks, pmdp_of, quick_tasks
from rp_jax.planning import loop
from rp_jax.runs.agents import side_by_side
from rp_jax.runs.plan import members_of
from rp_jax.streams import Stream, key_of, numbered

ITERATIONS = 25


def run(counts: tuple[int, ...] = (1, 2, 4, 8, 16)) -> list[Row]:
    """The loop on Jam, vmapped over seeds; the batch is their number."""
    world, config = quick_tasks()["jam"]
    one, planning = pmdp_of(world, config), config.planning
    key = key_of(jax.random.key(0), Stream.PLANNING)
    rows = []
    for count in counts:
        members = members_of(config.x, config.learning_penalty, count)
        pmdp, axes = side_by_side(one, members)
        init = jax.jit(jax.vmap(loop.init, (0, axes, None)), static_argnums=2)
        state, _ = init(numbered(key, list(range(count))), pmdp, planning)

        def program(state, pmdp, iterations=ITERATIONS, axes=axes):
            chunk = jax.vmap(loop.chunk, (0, axes, None, None))
            return chunk(state, pmdp, planning, iterations)

        turn = Piece(lambda s, p, program=program: program(s, p, 1), (state, pmdp), ITERATIONS)
        first = jax.tree.map(lambda a: a[0], state.states)
        pieces = [turn, *more_chunks(one, first, count * ITERATIONS)]
        steps = count * planning.num_envs * ITERATIONS
        made = ("jam", "steps", count, steps, program, state, pmdp)
        rows.append(measure(*made, repeats=3, carried=True, pieces=pieces))
    return rows


if __name__ == "__main__":
    main("seeds", run)
