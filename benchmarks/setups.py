"""P-MDPs with hardly trained threat models of the tuned sizes: weights do not change speed much."""

from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.bound import Piece
from experiments import circuit as circuit_experiment
from experiments import jam as jam_experiment
from experiments import point_gather as point_gather_experiment
from experiments import tasks
from rp_jax.planning.pmdp import PMDP
from rp_jax.recon import sampling
from rp_jax.threat import fit, total


def quick_tasks() -> dict[str, tuple[tasks.Task, tasks.Config]]:
    """The tasks with their quick settings."""
    found = {}
    for module in (circuit_experiment, jam_experiment, point_gather_experiment):
        config = module.quick("tuned")
        task = module.make_task(config)
        found[task.name] = (task, config)
    return found


def pmdp_of(task: tasks.Task, config: tasks.Config) -> PMDP:
    """The task's P-MDP. The models are fitted for 200 steps to threat 1 within .25 of the agent and
    0 elsewhere, so that actions are admissible at a plausible rate; their size is that of the tuned
    recipe."""
    models = {}
    for kind, sub in task.env.sub_rmdps(task.train).items():
        features = sampling.uniform(jax.random.key(1), sub, 1000)
        inside = jnp.linalg.norm(features[:, :2], axis=-1) < 0.25
        threat = jnp.repeat(inside[:, None].astype(jnp.float32), sub.agent.num_threats, axis=1)
        data = fit.Dataset(features, threat)
        settings = task.threats[kind].fit
        model, state = fit.init(jax.random.key(2), sub, data, settings)
        state, _ = fit.run(model, state, data, settings, 200)
        models[kind] = model.replace(params=state.params)
    return tasks.make_pmdp(task, config, models, task.train)


def inside(pmdp: PMDP, states: Any) -> dict[str, int]:
    """By kind, how many pairs of a state and a hazard in its reach are shown to the network."""
    assert pmdp.threats is not None
    found = {}
    hazards = jax.jit(jax.vmap(pmdp.env.hazards, (0, None)))(states, pmdp.params)
    for kind, group in hazards.items():
        reached = jax.jit(total.counted)(pmdp.threats[kind].source, states.agent, group)
        found[kind] = int(reached.sum())
    return found


def more_chunks(pmdp: PMDP, states: Any, turns: float = 1.0) -> list[Piece]:
    """What a query of the threat works beyond the first turn of its loops over chunks of pairs.

    Args:
        pmdp: with models.
        states: leading axis (B,), of the kind that is asked for.
        turns: queries.
    """
    assert pmdp.threats is not None
    pieces = []
    for kind, pairs in inside(pmdp, states).items():
        model = pmdp.threats[kind]
        rows = jnp.zeros((total.CHUNK, len(model.scale)))
        others = max(0, -(-pairs // total.CHUNK) - 1)
        pieces.append(Piece(lambda model, rows: model(rows), (model, rows), turns * others))
    return pieces
