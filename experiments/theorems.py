"""Every theorem on random CMDPs, against the exact worst policy: violations counted.

python -m experiments.theorems --instances 1000000
"""

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from rp_jax import storage
from rp_jax.cli import errors, terminal
from rp_jax.tabular import verify
from rp_jax.validate import number

ROUNDING = 1e-9  # a greater share of the greatest possible danger is a violation
HORIZONS = (1, 2, 4, None)
BATCH = 2_500


@dataclass(frozen=True)
class Config:
    """Settings of the check."""

    instances: int = 10_000  # random CMDPs, and as many factored models; shared by the horizons
    states: int = 4  # of a CMDP
    actions: int = 3
    seed: int = 0
    out: Path | None = None  # JSON file for the rows

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        number("instances", self.instances, least=1, integer=True)
        number("states", self.states, least=1, most=20, integer=True)
        number("actions", self.actions, least=1, most=31, integer=True)
        number("seed", self.seed, least=0, most=2**31 - 1, integer=True)


def programs(config: Config, horizon: int | None) -> dict[str, Callable[[Any], Any]]:
    """Returns functions from a key to violations: of all theorems, of Theorem 3 for two hazards."""
    return {
        "CMDPs": functools.partial(
            verify.violations, states=config.states, actions=config.actions, horizon=horizon
        ),
        "factored": functools.partial(
            verify.violations_of_theorem_3, states=3, actions=2, hazards=2, horizon=horizon
        ),
    }


def run(config: Config) -> list[dict[str, Any]]:
    """Returns one row per theorem and horizon, in double precision."""
    each = -(-config.instances // len(HORIZONS))
    rows = []
    with terminal.progress("theorems") as bar, jax.enable_x64(True):
        for h, horizon in enumerate(HORIZONS):
            for p, (kind, program) in enumerate(programs(config, horizon).items()):
                many = jax.jit(jax.vmap(program))
                key = jax.random.fold_in(jax.random.key(config.seed), 2 * h + p)
                found: dict[str, list[np.ndarray]] = {}
                seconds = 0.0
                for start in range(0, each, BATCH):
                    keys = jax.random.split(jax.random.fold_in(key, start), min(BATCH, each))
                    began = time.perf_counter()
                    batch = jax.device_get(many(keys))
                    if start:  # the first call compiles
                        seconds += time.perf_counter() - began
                    for name, values in batch.items():
                        found.setdefault(name, []).append(values[: each - start])
                    done = min(start + BATCH, each)
                    bar(f"T = {horizon or 'infinite'}, {kind}", done, each, "")
                for name, parts in found.items():
                    rows.append({"theorem": name, "horizon": horizon, **counted(parts)})
                    rows[-1]["per_second"] = (each - BATCH) / seconds if seconds else None
    return rows


def counted(parts: list[np.ndarray]) -> dict[str, Any]:
    """Counts the instances and the violations; nan is one."""
    values = np.concatenate(parts)
    return {
        "instances": len(values),
        "violations": int(np.sum(~(values <= ROUNDING))),
        "largest": float(values.max()),
    }


def main() -> None:
    """Exits with 1 on a violation, unless the rows that tell of it are written to a file."""
    config = tyro.cli(Config, description=__doc__)
    with errors.bad_input():
        config.validate()
        errors.needs_folder(config.out)
    rows = run(config)
    shown = [
        {
            "theorem": row["theorem"],
            "T": row["horizon"] or "infinite",
            "instances": f"{row['instances']:,}",
            "violations": f"{row['violations']:,}",
            "largest": f"{row['largest']:.1e}",
        }
        for row in rows
    ]
    terminal.table(f"violations above {ROUNDING:g}", shown, list(shown[0]))
    if config.out is not None:
        storage.write_json(config.out, rows)
    elif any(row["violations"] for row in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
