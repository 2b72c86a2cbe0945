"""Reconnaissance: labelled states and simulated sub-R-MDP steps per second, by estimator."""

import functools

import jax

from benchmarks.measure import Row, main, measure
from rp_jax.envs import circuit, jam
from rp_jax.recon import labels, sampling

PATHS = 64


def run(batch: int = 8192) -> list[Row]:
    """Exact labels of wall points, Monte Carlo labels of obstacles; all 15 actions each."""
    key = jax.random.key(0)
    rows = []
    wall = circuit.sub_rmdps(circuit.make_params())["wall"]
    obstacle = jam.sub_rmdps(jam.make_params())["obstacle"]
    sampled = functools.partial(labels.monte_carlo_threat, paths=PATHS)
    for name, sub, estimator in (
        ("wall point, exact", wall, labels.exact_threat),
        ("wall point, Monte Carlo", wall, sampled),
        ("obstacle, Monte Carlo", obstacle, sampled),
    ):
        pairs = jax.vmap(sub.source.state_of)(sampling.uniform(key, sub, batch))

        def program(key, agent, hazard, sub, estimator=estimator):
            return labels.label(key, agent, hazard, sub, estimator, rows=batch)

        made = (key, *pairs, sub)
        rows.append(measure(name, "states", batch, batch, program, *made))
        if estimator is sampled:
            simulated = batch * PATHS * 15 * sub.source.horizon
            rows.append(measure(name, "simulated steps", batch, simulated, program, *made))
    return rows


if __name__ == "__main__":
    main("recon", run)
