"""Figure 6: trajectories on the track that was learned and on others: RP, MPC, DQN."""

import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import runs, tasks
from experiments.paper.section import Claim, Section, holds
from rp_jax import evaluate, storage
from rp_jax.baselines import mpc
from rp_jax.envs import circuit
from rp_jax.planning import loop

TITLE = "Figure 6: trajectories on Circuit"
TRACKS = ("default", "narrowed", "circle")
EPISODES, STEPS_AHEAD = 8, 4


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """Per method and track, where the agent went, and where it crashed; keeps an animation."""
    lost = sources("circuit_lost")
    loaded = runs.load(lost)
    (folder / "animation.gif").write_bytes((lost / "animation.gif").read_bytes())
    planning = loaded.config.planning
    agents = sources("dqn_circuit") / "dqn" / "agent"
    members = storage.read_manifest(agents, "Q-network")["about"]["members"]
    first = next(i for i, member in enumerate(members) if member["learning_penalty"] == 0)
    found = []
    for track in TRACKS:
        pmdp = loaded.pmdp(track)
        told = pmdp.params.replace(lost=jnp.zeros(()))  # as DQN has learned
        free = pmdp.replace(params=told, threats=None, x=jnp.asarray(jnp.inf))
        dqn = runs.agents(agents, free, planning, len(members))
        network = loop.make_network(planning, pmdp)
        values = functools.partial(evaluate.action_values, network)
        tree = mpc.make_search(circuit, pmdp.params, STEPS_AHEAD, loaded.config.penalty)
        cases = {
            "RP": (pmdp, values, jax.tree.map(lambda a: a[0], loaded.params)),
            f"MPC, {STEPS_AHEAD} steps": (mpc.omniscient(tree), mpc.values, tree),
            "DQN, no penalty": (free, values, jax.tree.map(lambda a: a[first], dqn)),
        }
        for method, case in cases.items():
            found.append({"track": track, "method": method, "episodes": _played(*case)})
    return found


def _played(pmdp: Any, policy: Any, weights: Any) -> list[dict[str, Any]]:
    """Positions, and whether the wall was hit at each: from the start of the demo, and others."""
    from experiments import drawing

    key = tasks.key_of(0, tasks.STARTS)
    starts = jax.vmap(circuit.reset, (0, None))(jax.random.split(key, EPISODES - 1), pmdp.params)
    demo = circuit.demo_start(pmdp.params)
    starts = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), demo, starts)
    steps = int(pmdp.params.time_limit)
    episodes = drawing.recorded(key, pmdp, starts, steps, policy, weights)
    return [{"position": e.position.round(4), "hit": e.hit} for e in episodes]


def plot(results: list[dict[str, Any]], folder: Path) -> None:
    """A line per track, a column per method."""
    from rp_jax.plot import scenes

    panels = []
    for row in results:
        scene = scenes.Scene(np.asarray(circuit.make_params(row["track"]).track.walls))
        episodes = [
            scenes.Path2D(np.asarray(e["position"]), np.asarray(e["hit"], bool))
            for e in row["episodes"]
        ]
        panels.append((f"{row['method']}, {row['track']}", scene, episodes))
    scenes.trajectories(panels, folder / "figure_6.png")


def tell(results: list[dict[str, Any]]) -> Section:
    """Who crashes."""
    crashed = {
        (row["method"], row["track"]): sum(any(e["hit"]) for e in row["episodes"])
        for row in results
    }
    of_rp, of_dqn = (
        [count for (method, _), count in crashed.items() if method.startswith(name)]
        for name in ("RP", "DQN")
    )
    said = "; ".join(f"{m}, {t}: {n} of {EPISODES}" for (m, t), n in crashed.items())
    return Section(
        f"{EPISODES} episodes each. S: start; crosses: crashes. No seed was chosen: it is the "
        "first agent of each. RP: with the paper's baseline policy, and not told x and y where it "
        "did not learn.",
        claims=[
            Claim(
                "Figure 6: RP crashes on no track; unpenalised DQN crashes on the new ones",
                "no crash; crashes",
                said,
                holds(sum(of_rp) == 0 and min(of_dqn[1:]) > 0),
            )
        ],
        figures={
            "figure_6.png": "Trajectories; red crosses mark crashes.",
            "animation.gif": "RP on the track, and the threat of each action.",
        },
    )
