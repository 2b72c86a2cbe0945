"""Where to start rollouts: uniform against preferential sampling at equal simulated steps.

python -m experiments.sampling --out docs/results/sampling
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from rp_jax import recipes, storage
from rp_jax.cli import errors, terminal
from rp_jax.envs import circuit, jam
from rp_jax.hazards import SubRMDP
from rp_jax.recon import labels, sampling
from rp_jax.threat import build, report
from rp_jax.threat.build import ThreatConfig
from rp_jax.validate import number


@dataclass(frozen=True)
class Config:
    """Settings of the comparison."""

    out: Path = Path("results/sampling")  # folder for results
    sizes: tuple[int, ...] = (12_500, 25_000, 50_000, 100_000)  # labelled states
    repeats: int = 3  # fits per size, from different keys
    test_states: int = 2_000  # per test set
    steps: int = 6_000  # gradient steps of a fit

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        if not self.sizes:
            raise ValueError("sizes is (); it must name at least one number of states")
        for size in self.sizes:
            number("sizes", size, least=1000, integer=True)
        number("repeats", self.repeats, least=1, integer=True)
        number("test_states", self.test_states, least=100, integer=True)
        number("steps", self.steps, least=100, integer=True)


def test_sets(key: jax.Array, sub: SubRMDP, config: Config, x: float) -> dict[str, Any]:
    """Labels fresh states, the same for all: spread over the window, and where it matters."""
    keys = jax.random.split(key, 5)
    pool = sampling.uniform(keys[0], sub, 10 * config.test_states)
    rough = _label(keys[1], sub, pool, 256)
    order = np.argsort(-np.asarray(sampling.interest(rough, x)))[: config.test_states]
    spread = sampling.uniform(keys[2], sub, config.test_states)
    hard = pool[order]
    return {
        "over the window": (spread, np.asarray(_label(keys[3], sub, spread, 8192))),
        "where it matters": (hard, np.asarray(_label(keys[4], sub, hard, 8192))),
    }


def _label(key: jax.Array, sub: SubRMDP, features: jax.Array, paths: int) -> jax.Array:
    estimator = labels.best_estimator(sub, paths)
    body, hazard = sampling.states(sub, features)
    return labels.label(key, body, hazard, sub, estimator).threat


def run(config: Config) -> list[dict[str, Any]]:
    """Returns one row per hazard, size, sampling, repeat and test set."""
    cases: list[tuple[str, SubRMDP, ThreatConfig, float]] = [
        (
            "Circuit wall",
            circuit.sub_rmdps(circuit.make_params())["wall"],
            recipes.TUNED_WALL,
            1e-3,
        ),
        (
            "Jam obstacle",
            jam.sub_rmdps(jam.make_params())["obstacle"],
            recipes.TUNED_OBSTACLE,
            1e-2,
        ),
    ]
    total = len(cases) * len(config.sizes) * config.repeats * len(build.SAMPLINGS)
    rows = []
    with terminal.progress() as bar:
        bar("sampling", 0, total, "")
        for name, sub, tuned, x in cases:
            tests = test_sets(jax.random.key(99), sub, config, x)
            fit = dataclasses.replace(tuned.fit, steps=config.steps)
            for size in config.sizes:
                for repeat in range(config.repeats):
                    for kind in build.SAMPLINGS:
                        settings = dataclasses.replace(
                            tuned,
                            states=size,
                            sampling=kind,
                            miss_rate=1.0,
                            test_states=10,
                            fit=fit,
                        )
                        built = build.learn_threat(jax.random.key(repeat), sub, settings, x)
                        for test, (features, true) in tests.items():
                            said = np.asarray(report.predict(built.model, features))
                            rows.append(
                                {
                                    "hazard": name,
                                    "states": size,
                                    "sampling": kind,
                                    "repeat": repeat,
                                    "test": test,
                                    **report.compare(said, true, x),
                                }
                            )
                        bar("sampling", len(rows) // 2, total, "")
    return rows


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Draws errors against the number of labelled states."""
    from rp_jax.plot import curves

    curves.comparison(
        rows,
        panels=("hazard", "test"),
        line="sampling",
        horizontal="states",
        vertical=("rmse", "unsafe_called_safe"),
        path=path,
    )


def main() -> None:
    """Runs the command; exits with 2 on bad input."""
    config = tyro.cli(Config, description=__doc__)
    with errors.bad_input():
        config.validate()
        errors.needs_matplotlib()
        folder = storage.new_folder(config.out)
    with errors.bad_input():
        rows = run(config)
    storage.write_json(folder / "sampling.json", {"settings": config.__dict__, "rows": rows})
    plot(rows, folder / "sampling.png")
    terminal.say(f"results: {folder}")


if __name__ == "__main__":
    main()
