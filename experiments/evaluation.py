"""How the agents of a run do, seed by seed and variant by variant."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from flax import linen as nn

from experiments import console, tasks
from experiments.training import Member, Trained
from rp_jax import devices, evaluate
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.envs.base import Env
from rp_jax.planning.pmdp import PMDP

ROUND = 1000  # episodes of an agent side by side


class Agents(NamedTuple):
    """Who is evaluated."""

    members: Sequence[Member]
    names: Sequence[str]  # of their methods
    policy: Callable[[Any], evaluate.Policy]  # of one member's parameters
    trained: Trained


def evaluate_all(
    task: tasks.Task,
    config: tasks.Config,
    pmdp: PMDP,
    agents: Agents,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> list[dict[str, Any]]:
    """One row per variant and member.

    Raises:
        FloatingPointError: an observation, a threat or a reward is not a finite number.
    """
    members, trained = agents.members, agents.trained
    variants, episodes = play_all(task, config, pmdp, agents, checkpoints)
    first = jax.tree.map(lambda a: a[0], trained.params)
    rows = []
    for variant, this in variants.items():
        act = acting(this.replace(x=this.x[0]), agents.policy, first)
        seconds, _ = action_seconds(
            tasks.key_of(config.seed, tasks.EVALUATION), task.env, this.params, act
        )
        for i, member in enumerate(members):
            found = evaluate.summarise(
                jax.tree.map(lambda a, i=i: a[i], episodes[variant]), config.penalty
            )
            rows.append(
                {
                    "env": task.name,
                    "variant": variant,
                    "method": agents.names[i],
                    "x": member.x if pmdp.threats is not None else float("inf"),
                    "seed": member.seed,
                    **found,
                    "seconds_per_100_actions": seconds,
                    "train_seconds": trained.seconds,
                }
            )
    return rows


def play_all(
    task: tasks.Task, config: tasks.Config, pmdp: PMDP, agents: Agents, checkpoints: Checkpoints
) -> tuple[dict[str, PMDP], dict[str, evaluate.Episodes]]:
    """By variant, the members' P-MDPs and their episodes (members, episodes)."""
    pmdp, axes = tasks.side_by_side(pmdp, agents.members)
    count, batch = len(agents.members), min(ROUND, config.episodes)

    def one(key: jax.Array, params: Any, pmdp: PMDP) -> evaluate.Episodes:
        return evaluate.play_round(key, pmdp, agents.policy(params), batch)

    mesh, places = devices.mesh_of(config.devices), (0, 0, axes)
    everyone = jax.jit(devices.spread(one, places, mesh))
    keys, params = tasks.keys_of(agents.members, tasks.EVALUATION), agents.trained.params
    each = jax.vmap(lambda key: evaluate.round_keys(key, config.episodes, batch))(keys)
    variants = {name: pmdp.replace(params=test) for name, test in task.tests.items()}
    rounds, names = each.shape[1], list(variants)
    with console.progress(f"{agents.names[0]}, evaluation") as bar:

        def play(i: int, found: dict[str, evaluate.Episodes]) -> dict[str, evaluate.Episodes]:
            name, turn = names[i // rounds], i % rounds
            rows, begun = found[name], f"{turn * batch * count:,} of {rounds * batch * count:,}"
            bar("", i, len(names) * rounds, f"{name}: {begun} episodes")
            given = devices.place((each[:, turn], params, variants[name]), places, mesh)
            new = jax.tree.map(np.asarray, devices.gather(everyone(*given), mesh))
            evaluate.check(new, name)
            for whole, part in zip(jax.tree.leaves(rows), jax.tree.leaves(new), strict=True):
                whole[:, turn * batch : (turn + 1) * batch] = part
            bar("", i + 1, len(names) * rounds)
            return found

        shapes = jax.eval_shape(everyone, each[:, 0], params, variants[names[0]])
        blank = {
            name: jax.tree.map(lambda s: np.zeros((count, rounds * batch), s.dtype), shapes)
            for name in names
        }
        found = checkpoints.loop(blank, play, len(names) * rounds)
    return variants, jax.tree.map(lambda a: a[:, : config.episodes], found)


def greedily(network: nn.Module) -> Callable[[Any], evaluate.Policy]:
    """The policy of a Q-network's weights: greedy inside the admissible set."""
    return lambda weights: evaluate.shielded(evaluate.action_values(network, weights))


def acting(
    pmdp: PMDP, policy: Callable[[Any], evaluate.Policy], params: Any
) -> Callable[[Any], jax.Array]:
    """What chooses an action in a state, observation and threat included; compiled."""

    @jax.jit
    def act(state: Any, params: Any, pmdp: PMDP) -> jax.Array:
        percept = pmdp.perceive(jax.tree.map(lambda a: a[None], state))
        return policy(params)(jax.random.key(0), percept)[0][0]

    return lambda state: act(state, params, pmdp)


def action_seconds(
    key: jax.Array, env: Env, params: Any, act: Callable[[Any], jax.Array], actions: int = 100
) -> tuple[float, float]:
    """(wall, CPU) time of decisions, each in the state that the one before it led to.

    Args:
        key: of the environment.
        env: the environment.
        params: of it.
        act: maps a state to an action; called once before, to compile.
        actions: how many.
    """
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    clocks = lambda: np.asarray([time.perf_counter(), time.process_time()])  # noqa: E731
    state, seconds = reset(key, params), np.zeros(2)
    act(state).block_until_ready()
    for k in range(actions):
        began = clocks()
        action = act(state).block_until_ready()
        seconds += clocks() - began
        key = jax.random.fold_in(key, k)
        state, outcome = step(key, state, action, params)
        if outcome.done:
            state = reset(key, params)
    return float(seconds[0]), float(seconds[1])
