"""Reconnaissance: labelled states and simulated sub-R-MDP steps per second, by estimator."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.bound import Piece
from benchmarks.measure import Row, measure, recount
from benchmarks.report import main
from rp_jax.dynamics import num_threats
from rp_jax.envs import circuit, jam
from rp_jax.hazards import SubRMDP
from rp_jax.recon import labels, sampling

PATHS = 64
ERROR = 0.01  # standard error of a threat at which estimators are compared
BATCH = 8192
BATCHES = (1, 16, 256, 1024, 16_384)  # beside BATCH
ROWS = 32  # that `labels.label` has side by side


def cases() -> dict[str, tuple[SubRMDP, labels.Estimator]]:
    """Every estimator, on the hazards that it is used for."""
    sampled = functools.partial(labels.monte_carlo_threat, paths=PATHS)
    plans = functools.partial(labels.plan_threat, paths=PATHS)
    wall = circuit.sub_rmdps(circuit.make_params())["wall"]
    obstacle = jam.sub_rmdps(jam.make_params())["obstacle"]
    planned = jam.sub_rmdps(jam.make_params(baseline="plans"))["obstacle"]
    return {
        "wall point, exact": (wall, labels.exact_threat),
        "wall point, Monte Carlo": (wall, sampled),
        "obstacle, Monte Carlo": (obstacle, sampled),
        "obstacle, plans": (planned, plans),
    }


def row(name: str, sub: SubRMDP, estimator: labels.Estimator, batch: int) -> Row:
    """Labelled states per second, all actions of each."""
    key = jax.random.key(0)

    def program(key, body, hazard, sub):
        return labels.label_rows(key, body, hazard, sub, estimator, ROWS)

    def made(count: int) -> tuple[Any, ...]:
        features = sampling.uniform(key, sub, count)
        return (key, *sampling.states(sub, features), sub)

    side = min(batch, ROWS)
    piece = Piece(program, made(side), batch / side)
    return measure(name, "states", batch, batch, program, *made(batch), pieces=[piece])


def paths_needed(sub: SubRMDP, estimator: labels.Estimator, error: float, states: int) -> float:
    """Paths for which the root mean square of the standard errors is `error`.

    Over states spread over the window and all actions; it falls with the root of the paths.
    """
    key = jax.random.key(1)
    body, hazard = sampling.states(sub, sampling.uniform(key, sub, states))
    found = labels.label(key, body, hazard, sub, estimator)
    return PATHS * float(jnp.mean(jnp.square(found.stderr))) / error**2


def run(batch: int = BATCH, batches: Sequence[int] = BATCHES, states: int = 4096) -> list[Row]:
    """Labels of wall points and obstacles; all actions (and plans) of each state.

    "states at .01" are those labelled with a standard error of .01, as if the time of a label
    were in proportion to its paths.
    """
    rows = []
    for name, (sub, estimator) in cases().items():
        first = row(name, sub, estimator, batch)
        rows.append(first)
        each = 1.0
        if estimator is not labels.exact_threat:
            simulated = PATHS * num_threats(sub.body) * sub.source.horizon
            rows.append(recount(first, "simulated steps", simulated))
            each = PATHS / paths_needed(sub, estimator, ERROR, states)
        rows.append(recount(first, f"states at {ERROR:g}", each))
        rows += [row(name, sub, estimator, other) for other in batches]
    return rows


if __name__ == "__main__":
    main("recon", run)
