"""Beyond the paper: the sum of threats over wall points against the joint threat of all walls."""

import itertools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from experiments import console, runs, tasks
from experiments.paper.section import Section, Table
from rp_jax import evaluate
from rp_jax.envs.base import Hazards
from rp_jax.hazards import SubRMDP, WallPoint
from rp_jax.recon import labels
from rp_jax.threat import report
from rp_jax.threat.total import total_threat

TITLE = "Walls: summed or jointly"
RUNS = {"circuit": "circuit_lost", "jam": "jam"}  # of which agents were kept
STATES = 256
BINS = (0.0, 1e-3, 1e-2, 1e-1, 1.0)  # of the joint threat


class Walls(struct.PyTreeNode):
    """All wall points near the agent as one hazard."""

    wall: WallPoint

    @property
    def horizon(self) -> int:
        """Of a wall point."""
        return self.wall.horizon

    def hits(self, agent: Any, points: Hazards) -> Array:
        """Any of them is."""
        return jnp.any(jax.vmap(self.wall.hits, (None, 0))(agent, points.state) & points.present)


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """Per task: what the joint threat, the exact sum and the models' sum admit, in visited states.

    Joint and summed threats are exact: all rollouts are enumerated.
    """
    rows = []
    for env, name in RUNS.items():
        loaded = runs.load(sources(name))
        pmdp = loaded.pmdp(next(iter(loaded.task.tests)))
        key = tasks.key_of(loaded.config.seed, tasks.SUMS)
        states = jax.jit(evaluate.visited_states, static_argnums=2)(key, pmdp, STATES)
        points = jax.jit(jax.vmap(pmdp.env.hazards, (0, None)))(states, pmdp.params)["wall"]
        sub = pmdp.env.sub_rmdps(pmdp.params)["wall"]
        with console.progress(f"walls, {env}") as bar:
            bar("", 0, 1)
            joint, summed = exact(key, states.agent, points, sub)
            bar("", 1, 1)
        assert pmdp.threats is not None
        said = total_threat({"wall": pmdp.threats["wall"]}, states.agent, {"wall": points})
        kinds = {"joint, exact": joint, "sum, exact": summed, "sum, models": said}
        for name, threat in kinds.items():
            rows.append(
                {"env": env, "of": name, "x": loaded.config.x}
                | compared(np.asarray(threat), joint, loaded.config.x)
            )
    return rows


def exact(key: Array, agents: Any, points: Hazards, sub: SubRMDP) -> tuple[np.ndarray, np.ndarray]:
    """(joint, summed) threats (B, A) of the wall points near agents (B, ...)."""
    walls: Any = Walls(wall=sub.source)
    both = sub.replace(source=walls)
    count = points.present.shape[0]
    joint = labels.label(key, agents, points, both, labels.exact_threat, rows=count)
    summed = report.labelled_sum(key, agents, points, sub, labels.exact_threat)
    return np.asarray(joint.threat), summed


def compared(threat: np.ndarray, joint: np.ndarray, x: float) -> dict[str, Any]:
    """What threats (B, A) admit at x, and by how much they exceed the joint ones."""
    ratios = []
    for low, high in itertools.pairwise(BINS):
        inside = (joint > low) & (joint <= high)
        ratios.append(float((threat[inside] / joint[inside]).mean()) if inside.any() else None)
    return {
        "admissible": float((threat <= x).mean()),
        "secure": float((threat.min(axis=1) <= x).mean()),
        "below_joint": float((threat < joint - 1e-6).mean()),
        "ratios": ratios,
    }


def tell(results: list[dict[str, Any]]) -> Section:
    """What the sum costs."""
    names = [f"{low:g} to {high:g}" for low, high in itertools.pairwise(BINS)]
    lines = []
    for row in results:
        ratios = ["" if ratio is None else f"{ratio:.2f}" for ratio in row["ratios"]]
        lines.append(
            {
                "task": row["env"],
                "threat of walls": row["of"],
                "admissible pairs, %": f"{100 * row['admissible']:.1f}",
                "states with an admissible action, %": f"{100 * row['secure']:.1f}",
                **{f"ratio to joint, {n}": r for n, r in zip(names, ratios, strict=True)},
            }
        )
    return Section(
        f"{STATES} states that exploring inside the admissible set comes by, all actions; the "
        "paper's baseline policy. Theorem 3 bounds the joint threat by the sum; no agent was "
        "trained under the joint one. Under plans (tables 1 and 2) walls are joint.",
        tables=[
            Table("The threat of all walls: admitted at x, and mean ratio to the joint", lines)
        ],
    )
