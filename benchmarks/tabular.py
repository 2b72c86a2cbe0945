"""Finite CMDPs solved per second: vmapped exact solutions against scipy's linear programs."""

import statistics
import time

import jax
import jax.numpy as jnp

from benchmarks.measure import Row, main, measure
from rp_jax.tabular import oracle, secure, threat, thresholds, verify
from rp_jax.tabular.cmdp import FiniteCMDP

STATES, ACTIONS, HORIZON, C = 8, 4, 20, 0.5


def solved(cmdp: FiniteCMDP) -> jax.Array:
    """() Algorithm 1 from nothing: eta*, its threat, the evaluated x, and the best return inside.

    And the worst danger that any policy inside can do, as the proof.
    """
    star = threat.least_threat(cmdp)
    chosen, planned = thresholds.planned(cmdp, C, star.policy, thresholds.by_evaluation)
    worst = secure.worst(cmdp, chosen.shield.admissible)
    return jnp.stack([threat.expected(cmdp, planned), threat.expected(cmdp, worst)])


def drawn(key: jax.Array) -> FiniteCMDP:
    """A random CMDP with rewards."""
    cmdp = verify.draw(key, STATES, ACTIONS, HORIZON).cmdp
    reward = jax.random.uniform(jax.random.fold_in(key, 1), cmdp.danger.shape)
    return cmdp.replace(reward=reward)


def run(batches: tuple[int, ...] = (1, 256, 4096), programs: int = 20) -> list[Row]:
    """Both in double precision."""
    with jax.enable_x64(True):
        rows = []
        for batch in batches:
            many = jax.jit(jax.vmap(drawn))(jax.random.split(jax.random.key(0), batch))
            rows.append(measure("Algorithm 1", "CMDPs", batch, batch, jax.vmap(solved), many))
        few = jax.jit(jax.vmap(drawn))(jax.random.split(jax.random.key(0), programs))
        few = [jax.tree.map(lambda leaf, i=i: leaf[i], few) for i in range(programs)]
        rates = []
        for cmdp in few:
            least = float(threat.expected(cmdp, threat.least_threat(cmdp)))
            began = time.perf_counter()
            oracle.optimum(cmdp, max(C, least * (1 + 1e-9)))
            rates.append(1 / (time.perf_counter() - began))
    middle = statistics.median(rates)
    row = Row("linear program", "CMDPs", 1, middle, min(rates), max(rates), 0.0, rows[-1].peak_mib)
    return [*rows, row]


if __name__ == "__main__":
    main("tabular", run)
