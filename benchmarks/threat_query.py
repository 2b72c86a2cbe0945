"""Total threats per second, of states that exploration comes by."""

import jax

from benchmarks.measure import Row, main, measure
from benchmarks.setups import pmdp_of, tasks
from rp_jax import evaluate


def run(batches: tuple[int, ...] = (1, 16, 256, 4096)) -> list[Row]:
    """States per second, all actions and all hazards of each, by batch."""
    rows = []
    for name, (task, config) in tasks().items():
        pmdp = pmdp_of(task, config)
        for batch in batches:
            states = jax.jit(evaluate.visited_states, static_argnums=2)(
                jax.random.key(0), pmdp, batch
            )
            program = lambda pmdp, states: pmdp.threat(states)  # noqa: E731
            rows.append(measure(name, "states", batch, batch, program, pmdp, states, repeats=20))
    return rows


if __name__ == "__main__":
    main("threat_query", run)
