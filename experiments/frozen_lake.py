"""Frozen Lake (figures 2 and 3), solved exactly: what each baseline and threshold rule earns.

python -m experiments.frozen_lake
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from rp_jax import storage
from rp_jax.cli import errors, terminal
from rp_jax.cli.experiment import default_out
from rp_jax.runs.train import can_draw
from rp_jax.tabular import exact, frozen_lake, oracle, secure, thresholds
from rp_jax.tabular.cmdp import FiniteCMDP
from rp_jax.validate import number

BASELINES = ("eta 0", "eta 1", "eta 2", "eta*")
COLUMNS = {  # of the table that is shown, by field
    "rule": "rule",
    "c": "c, danger allowed",
    "x": "threshold x",
    "return_mean": "mean return",
    "share": "share of the optimum",
    "danger": "danger",
    "worst_danger": "danger of the worst policy",
}


@dataclass(frozen=True)
class Config:
    """Settings of the experiment."""

    out: Path | None = None  # folder for results; default: results/frozen_lake-exact-TIME
    horizons: tuple[int, ...] = (100, 200)  # steps of an episode
    c: tuple[float, ...] = (0.01, 0.05, 0.1, 0.2)  # bounds on the danger, in the table
    curve: tuple[float, ...] = (0.002, 0.005, 0.02, 0.03, 0.07, 0.15, 0.3, 0.5)  # also in figures
    slip: float = 2 / 3  # probability of moving sideways
    program: bool = True  # solve one linear program per lake, as a check of the optimum
    figures: bool = field(default_factory=can_draw)  # draw, with matplotlib

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        for name in ("horizons", "c"):
            if not getattr(self, name):
                raise ValueError(f"{name} is (); it must have at least one value")
        for horizon in self.horizons:
            number("horizons", horizon, least=1, most=1000, integer=True)
        for name in ("c", "curve"):
            for c in getattr(self, name):
                number(name, c, least=0)
        number("slip", self.slip, least=0, most=1)


def solve_all(lakes: FiniteCMDP, c: jax.Array) -> dict[str, Any]:
    """Solves every lake for every baseline, rule and bound.

    Args:
        lakes: (L, ...) CMDPs of one horizon.
        c: (C,) bounds.

    Returns:
        By rule, arrays (L, B, C): the danger of greedy-eta, x, return, danger, and the worst
        danger inside the sets.
    """

    def one(lake: FiniteCMDP, policy: jax.Array, c: jax.Array, rule: Any) -> dict[str, Any]:
        chosen, planned = thresholds.planned(lake, c, policy, rule)
        worst = secure.worst(lake, chosen.shield.admissible)
        least = exact.greedy(exact.threat(lake, policy).action)
        return {
            "baseline_danger": exact.expected(lake, exact.threat(lake, least)),
            "x": chosen.x,
            "return_mean": exact.expected(lake, planned),
            "danger": exact.expected(lake, exact.threat(lake, planned.policy)),
            "worst_danger": exact.expected(lake, worst),
        }

    def over(lake: FiniteCMDP, rule: Any) -> dict[str, Any]:
        etas = exact.policy_iteration(lake, exact.uniform(lake), 2)
        policies = jnp.stack([*etas, exact.least_threat(lake).policy])
        over_c = jax.vmap(one, in_axes=(None, None, 0, None))
        return jax.vmap(over_c, in_axes=(None, 0, None, None))(lake, policies, c, rule)

    return {
        name: jax.vmap(over, in_axes=(0, None))(lakes, rule)
        for name, rule in thresholds.RULES.items()
    }


def run(config: Config) -> dict[str, Any]:
    """Returns the rows of the table, the curves, and what figure 2 shows."""
    bounds = sorted({*config.c, *config.curve})
    rows, optima, programs = [], [], []
    total = len(config.horizons) * (1 + 2 * len(frozen_lake.HOLES))
    with terminal.progress() as bar:
        done = 0
        for horizon in config.horizons:
            lakes = [
                frozen_lake.frozen_lake(holes=holes, horizon=horizon, slip=config.slip)
                for holes in frozen_lake.HOLES
            ]
            bar("frozen lake", done, total, f"T = {horizon}: rules")
            together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *lakes)
            solved = jax.device_get(jax.jit(solve_all)(together, jnp.asarray(bounds)))
            done += 1
            for i, (holes, lake) in enumerate(zip(frozen_lake.HOLES, lakes, strict=True)):
                variant = f"T={horizon}, {holes} holes"
                bar("frozen lake", done, total, f"{variant}: all Lagrange multipliers")
                vertices = oracle.frontier(lake, upto=max(bounds))
                optima += lagrangian_rows(variant, vertices, bounds)
                best = {c: oracle.mixed(vertices, c) for c in bounds}
                rows += rule_rows(variant, bounds, best, solved, i)
                bar("frozen lake", done + 1, total, f"{variant}: linear program")
                if config.program:
                    programs.append(check(variant, lake, config.c[0], best[config.c[0]]))
                done += 2
        bar("frozen lake", total, total, "")
    return {"rows": rows, "optima": optima, "programs": programs, "map": threat_map(config)}


def rule_rows(
    variant: str,
    bounds: Sequence[float],
    best: Mapping[float, float],
    solved: Mapping[str, Mapping[str, np.ndarray]],
    lake: int,
) -> list[dict[str, Any]]:
    """Returns a row per rule, baseline and bound; null where the baseline policy is not safe."""
    rows = []
    for rule in thresholds.RULES:
        found = solved[rule]
        for b, baseline in enumerate(BASELINES):
            for i, c in enumerate(bounds):
                values = {name: float(array[lake, b, i]) for name, array in found.items()}
                # What Corollary 2 asks of a baseline policy: that greedy-eta keeps c.
                safe = values.pop("baseline_danger") <= c + 1e-12
                row: dict[str, Any] = {"env": "frozen_lake", "variant": variant, "method": "RP"}
                row |= {"baseline": baseline, "rule": rule, "c": c, "safe_baseline": safe}
                row |= {name: value if safe else None for name, value in values.items()}
                share = values["return_mean"] / best[c] if best[c] > 0 else float("nan")
                rows.append({**row, "optimum": best[c], "share": share if safe else None})
    return rows


def lagrangian_rows(
    variant: str, vertices: Sequence[oracle.Vertex], bounds: Sequence[float]
) -> list[dict[str, Any]]:
    """Returns the exact optimum at each bound, and the best policy of one Lagrange multiplier."""
    rows = []
    for c in bounds:
        single = oracle.unmixed(list(vertices), c)
        rows.append(
            {
                "variant": variant,
                "c": c,
                "optimum": oracle.mixed(list(vertices), c),
                "lagrangian": None if single is None else single.value,
                "lagrangian_danger": None if single is None else single.danger,
                "vertices": len(vertices),
            }
        )
    return rows


def check(variant: str, lake: FiniteCMDP, c: float, best: float) -> dict[str, Any]:
    """Compares the linear program's optimum with that of the Lagrangian curve."""
    began = time.perf_counter()
    value = oracle.optimum(lake, c).value
    seconds = time.perf_counter() - began
    return {
        "variant": variant,
        "c": c,
        "linear_program": value,
        "lagrangian": best,
        "difference": value - best,
        "seconds": seconds,
    }


def threat_map(config: Config) -> dict[str, Any]:
    """Returns T_0 of eta* on the map, where falling ends the episode: threats are probabilities."""
    horizon = config.horizons[0]
    lake = frozen_lake.frozen_lake(holes="paper", horizon=horizon, slip=config.slip)
    action = exact.least_threat(lake).action[0]
    rows = frozen_lake.MAP_8X8
    cells = np.asarray(action[: len(rows) * len(rows[0])]).T  # without the end of the episode
    return {
        "rows": list(rows),
        "horizon": horizon,
        "threat": cells.reshape(len(frozen_lake.ACTIONS), len(rows), len(rows[0])).tolist(),
    }


def show(results: Mapping[str, Any], config: Config) -> None:
    """Prints the table for the best baseline."""
    for variant in dict.fromkeys(row["variant"] for row in results["rows"]):
        rows = [
            {words: _cell(name, row[name]) for name, words in COLUMNS.items()}
            for row in sorted(results["rows"], key=lambda row: row["c"])
            if row["variant"] == variant and row["c"] in config.c and row["baseline"] == "eta*"
        ]
        terminal.table(f"{variant}, baseline eta*", rows, list(COLUMNS.values()))
    if results["programs"]:
        rows = [
            {
                "variant": row["variant"],
                "c, danger allowed": row["c"],
                "optimum by linear program": row["linear_program"],
                "by Lagrange multipliers": row["lagrangian"],
                "difference": f"{row['difference']:.1e}",
                "linear program, seconds": row["seconds"],
            }
            for row in results["programs"]
        ]
        terminal.table("the optimum, twice", rows, list(rows[0]))


def _cell(name: str, value: Any) -> str:
    """Small dangers keep their digits; none where the baseline is not safe."""
    if value is None:
        return "-"
    return value if isinstance(value, str) else f"{value:.{3 if 'danger' in name else 4}g}"


def plot_map(shown: Mapping[str, Any], path: Path) -> None:
    """Draws figure 2, from what `threat_map` found."""
    from rp_jax.plot import finite

    title = f"action threat of eta*, T = {shown['horizon']}"
    threats = np.asarray(shown["threat"])
    finite.lake(shown["rows"], threats, frozen_lake.ACTIONS, title, path)


def plot_rules(results: Mapping[str, Any], folder: Path) -> None:
    """Draws figures 3a and 3b, and the rules' shares of the optimum."""
    from rp_jax.plot import finite

    finite.budgets(results["rows"], results["optima"], BASELINES, folder / "figure_3.png")
    finite.shares(results["rows"], tuple(thresholds.RULES), folder / "rules.png")


def main() -> None:
    """Runs the command; exits with 2 on bad input."""
    config = tyro.cli(Config, description=__doc__)
    with errors.bad_input():
        config.validate()
        errors.needs_matplotlib(config.figures)
        folder = storage.new_folder(config.out or default_out("frozen_lake-exact"))
    with jax.enable_x64(True):
        results = run(config)
    settings = {name: str(v) if isinstance(v, Path) else v for name, v in asdict(config).items()}
    storage.write_json(folder / "config.json", settings)
    storage.write_json(folder / "table.json", results["rows"])
    others = {name: value for name, value in results.items() if name != "rows"}
    storage.write_json(folder / "optima.json", others)
    show(results, config)
    if config.figures:
        plot_map(results["map"], folder / "figure_2.png")
        plot_rules(results, folder)
    terminal.say(f"results: {folder}")


if __name__ == "__main__":
    main()
