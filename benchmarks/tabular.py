"""Finite CMDPs solved per second: vmapped exact solutions against scipy's linear programs."""

import math
import time

import jax
import jax.numpy as jnp

from benchmarks.bound import Piece
from benchmarks.measure import Row, measure, row_of
from benchmarks.report import main
from rp_jax.tabular import exact, oracle, secure, thresholds, verify
from rp_jax.tabular.cmdp import FiniteCMDP

STATES, ACTIONS, HORIZON, C = 8, 4, 20, 0.5


def solved(cmdp: FiniteCMDP) -> jax.Array:
    """Solves a CMDP by Algorithm 1: eta*, its threat, the evaluated x, and the best return inside.

    Returns the return, and the worst danger that any policy inside can do, as the proof, (2,).
    """
    star = exact.least_threat(cmdp)
    chosen, planned = thresholds.planned(cmdp, C, star.policy, thresholds.by_evaluation)
    worst = secure.worst(cmdp, chosen.shield.admissible)
    return jnp.stack([exact.expected(cmdp, planned), exact.expected(cmdp, worst)])


def drawn(key: jax.Array, horizon: int = HORIZON) -> FiniteCMDP:
    """A random CMDP with rewards."""
    key, reward_key = jax.random.split(key)
    cmdp = verify.draw(key, STATES, ACTIONS, horizon).cmdp
    reward = jax.random.uniform(reward_key, cmdp.danger.shape)
    return cmdp.replace(reward=reward)


def _pieces(batch: int) -> list[Piece]:
    """What Algorithm 1 works: its loops go over the steps, once in each turn of a bisection."""
    keys = jax.random.split(jax.random.key(0), batch)
    short = jax.jit(jax.vmap(lambda key: drawn(key, 1)))(keys)
    turns = math.ceil(math.log2(HORIZON * STATES * ACTIONS))
    worst = lambda cmdp: secure.worst(cmdp, cmdp.danger[None] >= 0)  # noqa: E731
    return [
        Piece(jax.vmap(solved), (short,), HORIZON),
        Piece(jax.vmap(worst), (short,), HORIZON * (turns - 1)),
    ]


def run(batches: tuple[int, ...] = (1, 256, 4096), programs: int = 20) -> list[Row]:
    """Both in double precision."""
    with jax.enable_x64(True):
        rows = []
        for batch in batches:
            many = jax.jit(jax.vmap(drawn))(jax.random.split(jax.random.key(0), batch))
            pieces = _pieces(batch)
            made = ("Algorithm 1", "CMDPs", batch, batch, jax.vmap(solved), many)
            rows.append(measure(*made, pieces=pieces))
        few = jax.jit(jax.vmap(drawn))(jax.random.split(jax.random.key(0), programs))
        few = [jax.tree.map(lambda leaf, i=i: leaf[i], few) for i in range(programs)]
        rates = []
        for cmdp in few:
            least = float(exact.expected(cmdp, exact.least_threat(cmdp)))
            began = time.perf_counter()
            oracle.optimum(cmdp, max(C, least * (1 + 1e-9)))
            rates.append(1 / (time.perf_counter() - began))
    return [*rows, row_of("linear program", "CMDPs", 1, rates)]


if __name__ == "__main__":
    main("tabular", run)
