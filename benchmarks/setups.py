"""P-MDPs with hardly trained threat models of the tuned sizes: weights do not change speed much."""

from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.bound import Piece
from experiments.tasks import EXPERIMENTS
from rp_jax.cli.experiment import threats_of
from rp_jax.dynamics import num_threats
from rp_jax.planning.pmdp import PMDP
from rp_jax.recon import sampling
from rp_jax.runs.plan import make_pmdp
from rp_jax.runs.train import TrainConfig, World
from rp_jax.threat import fit, total
from rp_jax.threat.function import ThreatFunction


def quick_tasks() -> dict[str, tuple[World, TrainConfig]]:
    """Returns the tasks with their quick settings, by name."""
    configs = {name: module.quick("tuned") for name, module in EXPERIMENTS.items()}
    return {
        name: (EXPERIMENTS[name].make_world(config), config) for name, config in configs.items()
    }


def pmdp_of(world: World, config: TrainConfig) -> PMDP:
    """Returns a task's P-MDP.

    The models are fitted for 200 steps to threat 1 within .25 of the agent and 0 elsewhere, so that
    actions are admissible at a plausible rate; their size is that of the tuned recipe.
    """
    params, models = world.params(), {}
    subs = world.env.sub_rmdps(params)
    for kind, sub in subs.items():
        features = sampling.uniform(jax.random.key(1), sub, 1000)
        inside = jnp.linalg.norm(features[:, :2], axis=-1) < 0.25
        threat = jnp.repeat(inside[:, None].astype(jnp.float32), num_threats(sub.body), axis=1)
        data = fit.Dataset(features, threat)
        settings = threats_of(config)[kind].fit
        model, state = fit.init(jax.random.key(2), sub, data, settings)
        state, _ = fit.run(model, state, data, settings, 200)
        models[kind] = model.replace(params=state.params)
    function = ThreatFunction(models, subs)
    return make_pmdp(world.env, params, function, x=config.x, config=config.planning)


def inside(pmdp: PMDP, states: Any) -> dict[str, int]:
    """Returns, by kind, how many pairs of a state and a hazard are shown to the network."""
    found = {}
    hazards = jax.jit(jax.vmap(pmdp.env.hazards, (0, None)))(states, pmdp.params)
    for kind, group in hazards.items():
        reached = jax.jit(total.counted)(pmdp.threats[kind].source, states.body, group)
        found[kind] = int(reached.sum())
    return found


def more_chunks(pmdp: PMDP, states: Any, turns: float = 1.0) -> list[Piece]:
    """Returns the work of a threat query beyond the first turn of its loops over chunks of pairs.

    Args:
        pmdp: with models.
        states: leading axis (B,), of the kind that is asked for.
        turns: queries.
    """
    pieces = []
    for kind, pairs in inside(pmdp, states).items():
        model = pmdp.threats[kind]
        rows = jnp.zeros((total.CHUNK, len(model.scale)))
        others = max(0, -(-pairs // total.CHUNK) - 1)
        pieces.append(Piece(lambda model, rows: model(rows), (model, rows), turns * others))
    return pieces
