"""Figure 6: trajectories on the track that was learned and on others: RP, MPC, DQN."""

import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rp_jax
from experiments.figures import words
from experiments.paper.scores import read
from experiments.paper.section import Claim, Section, holds
from rp_jax import evaluation
from rp_jax.baselines import mpc
from rp_jax.cli.experiment import world_of
from rp_jax.envs import circuit
from rp_jax.streams import Stream, key_of

TITLE = "Figure 6: trajectories on Circuit"
TRACKS = ("default", "narrowed", "circle")
EPISODES, STEPS_AHEAD = 8, 4


def run(sources: Any, folder: Path) -> list[dict[str, Any]]:
    """Per method and track, where the agent went, and where it crashed; keeps an animation."""
    made = sources("circuit_lost")
    (folder / "animation.gif").write_bytes((made / "animation.gif").read_bytes())
    world, agent = world_of(made), rp_jax.load(made)[0]
    penalty = read(made / "config.json")["config"]["penalty"]
    others = rp_jax.load(sources("dqn_circuit") / "dqn")
    (free, *_) = (a for a, m in zip(others, others.members, strict=True) if not m.learning_penalty)
    found = []
    for track in TRACKS:
        params = world.params(track)
        told = params.replace(hide_position=jnp.zeros(()))  # as DQN has learned
        tree = mpc.make_search(circuit, params, STEPS_AHEAD, penalty)
        cases = {
            "RP": (agent.pmdp.replace(params=params), _values(agent), agent.weights),
            f"MPC, {STEPS_AHEAD} steps": (mpc.omniscient(tree), mpc.values, tree),
            "DQN, no penalty": (free.pmdp.replace(params=told), _values(free), free.weights),
        }
        for method, case in cases.items():
            found.append({"track": track, "method": method, "episodes": _played(*case)})
    return found


def _values(agent: rp_jax.Agent) -> Any:
    """From weights to the action values of a percept."""
    return functools.partial(evaluation.action_values, agent.network)


def _played(pmdp: Any, policy: Any, weights: Any) -> list[dict[str, Any]]:
    """Positions, and whether the wall was hit at each: from the start of the demo, and others."""
    from experiments.figures import shared

    key = jax.random.key(0)
    keys = jax.random.split(key_of(key, Stream.STARTS), EPISODES - 1)
    starts = jax.vmap(circuit.reset, (0, None))(keys, pmdp.params)
    demo = circuit.demo_start(pmdp.params)
    starts = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), demo, starts)
    own, steps = key_of(key, Stream.RECORDING), int(pmdp.params.time_limit)
    episodes = shared.recorded(own, pmdp, starts, steps, policy, weights)
    return [{"position": e.position.round(4), "hit": e.hit} for e in episodes]


def plot(results: list[dict[str, Any]], folder: Path) -> None:
    """A line per track, a column per method."""
    from experiments.figures import circuit_figures
    from rp_jax.plot import scenes

    panels = []
    for row in results:
        scene = circuit_figures.scene_of(circuit.make_params(row["track"]).track)
        episodes = [
            scenes.Path2D(np.asarray(e["position"]), np.asarray(e["hit"], bool))
            for e in row["episodes"]
        ]
        panels.append((f"{row['method']}, {words.variant(row['track'])}", scene, episodes))
    scenes.trajectories(panels, folder / "figure_6.png")


def tell(results: list[dict[str, Any]]) -> Section:
    """Returns the section on who crashes."""
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
