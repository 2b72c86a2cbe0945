"""A saved threat function against recorded exact (or 2-million-path) threats of single hazards.

python -m experiments.truth --env jam --threat results/RUN/threat
"""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import tyro
from jax import Array

from experiments.tasks import EXPERIMENTS
from rp_jax import storage
from rp_jax.cli import errors, results
from rp_jax.threat import report
from rp_jax.threat.function import load_threat
from rp_jax.threat.model import ThreatModel
from rp_jax.validate import one_of

RECORDED = {"wall": "wall", "obstacle": "car"}  # kinds of hazard as the files call them


@dataclass(frozen=True)
class Config:
    """Settings of the comparison."""

    env: str  # circuit or jam
    threat: Path  # folder of the threat function
    data: Path = Path("tests/data")  # folder of the recorded threats
    out: Path | None = None  # JSON file for the rows


def features_of(states: np.ndarray) -> Array:
    """Returns features (n, F) of states (x, y, [relative heading, other speed,] own speed)."""
    if states.shape[1] == 3:
        return jnp.asarray(states, jnp.float32)
    x, y, turn, other, own = states.T
    columns = [x, y, np.cos(turn), np.sin(turn), other, own]
    return jnp.asarray(np.stack(columns, axis=-1), jnp.float32)


def compare(model: ThreatModel, recorded: Path, x: float) -> dict[str, dict[str, float]]:
    """Returns the errors on each set of states in a file; names end alike, as in `_near`."""
    try:
        with np.load(recorded) as file:
            data = dict(file)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"data: {recorded} cannot be read ({error}); it must be there") from error
    found = {}
    for name in ("states", "states_near"):
        if name in data:
            said = np.asarray(report.predict(model, features_of(data[name])))
            true = data[name.replace("states", "truth")]
            found[name.removeprefix("states").strip("_") or "window"] = report.compare(
                said, true, x
            )
    return found


def run(config: Config) -> list[dict[str, Any]]:
    """Returns one row per hazard and set of states, and prints them."""
    module = EXPERIMENTS[one_of("env", config.env, ("circuit", "jam"))]
    settings = module.quick("tuned")
    world = module.make_world(settings)
    threat = load_threat(config.threat, world.env.sub_rmdps(world.params()))
    rows = []
    for kind, model in threat.models.items():
        path = config.data / f"threat_truth_{config.env}_{RECORDED[kind]}.npz"
        for name, found in compare(model, path, settings.x).items():
            rows.append({"hazard": kind, "of": name, **found})
    results.show_threats(rows, settings.x, "recorded threats")
    return rows


if __name__ == "__main__":
    chosen = tyro.cli(Config, description=__doc__)
    with errors.bad_input():
        errors.needs_folder(chosen.out)
        found = run(chosen)
        if chosen.out is not None:
            storage.write_json(chosen.out, found)
