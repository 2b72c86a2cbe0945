"""Beyond the paper: the sum of threats over wall points against the joint threat of all walls."""

import itertools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from experiments.paper.section import Section, Table
from rp_jax import recording
from rp_jax.cli import terminal
from rp_jax.cli.choice import Choice, chosen
from rp_jax.envs.contract import Hazards
from rp_jax.hazards import SubRMDP, WallPoint
from rp_jax.recon import labels
from rp_jax.streams import Stream, key_of
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
        """The horizon of a wall point."""
        return self.wall.horizon

    def hits(self, body: Any, points: Hazards) -> Array:
        """Returns whether any of the wall points is hit."""
        return jnp.any(jax.vmap(self.wall.hits, (None, 0))(body, points.state) & points.present)


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """Per task: what the joint threat, the exact sum and the models' sum admit, in visited states.

    Joint and summed threats are exact: all rollouts are enumerated.
    """
    rows = []
    for env, name in RUNS.items():
        agents = chosen(Choice(run=sources(name))).agents
        pmdp, member = agents[0].pmdp, agents.members[0]
        key = key_of(jax.random.key(member.seed), Stream.SUMS)
        states = jax.jit(recording.visited_states, static_argnums=2)(key, pmdp, STATES)
        points = jax.jit(jax.vmap(pmdp.env.hazards, (0, None)))(states, pmdp.params)["wall"]
        sub = pmdp.env.sub_rmdps(pmdp.params)["wall"]
        with terminal.progress() as bar:
            bar(f"walls, {env}", 0, 1, "")
            joint, summed = exact(key, states.body, points, sub)
            bar(f"walls, {env}", 1, 1, "")
        said = total_threat({"wall": pmdp.threats["wall"]}, states.body, {"wall": points})
        kinds = {"joint, exact": joint, "sum, exact": summed, "sum, models": said}
        for kind, threat in kinds.items():
            admitted = compared(np.asarray(threat, float), joint, member.x)
            rows.append({"env": env, "of": kind, "x": member.x, **admitted})
    return rows


def exact(key: Array, bodies: Any, points: Hazards, sub: SubRMDP) -> tuple[np.ndarray, np.ndarray]:
    """Returns (joint, summed) threats (B, A) of the wall points near bodies (B,)."""
    walls: Any = Walls(wall=sub.source)
    both = sub.replace(source=walls)
    count = points.present.shape[0]
    joint = labels.label(key, bodies, points, both, labels.exact_threat, rows=count)
    summed = report.labelled_sum(key, bodies, points, sub, labels.exact_threat)
    return np.asarray(joint.threat), summed


def compared(threat: np.ndarray, joint: np.ndarray, x: float) -> dict[str, Any]:
    """Returns what threats (B, A) admit at x, and by how much they exceed the joint ones."""
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
    """Returns the section on what the sum costs."""
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
