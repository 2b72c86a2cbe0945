"""Evaluation as a job: how agents do, in episodes by the thousand."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from flax import linen as nn
from jax import Array

from rp_jax import devices as sharing
from rp_jax import evaluation, statistics
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.envs import optional
from rp_jax.envs.contract import Env
from rp_jax.planning.pmdp import PMDP
from rp_jax.rollout import Policy
from rp_jax.runs import record
from rp_jax.runs.agents import Agent, Agents, Member, side_by_side, with_member
from rp_jax.runs.progress import OnProgress, silent
from rp_jax.runs.tables import Table
from rp_jax.streams import Stream, key_of, numbered
from rp_jax.validate import number, one_of, path, random_key, shown

ROUND = 1000  # episodes of an agent side by side


def evaluate(
    key: Array,
    agents: Agents,
    env: Env | None = None,
    params: Any = None,
    *,
    c: float | None = None,
    episodes: int = 10_000,
    penalty: float = 0.0,
    name: str = "",
    folder: str | Path | None = None,
    devices: str = "one",
    on_progress: OnProgress = silent,
) -> Table:
    """Plays episodes of each agent, and says what they earned and how often they crashed.

    Args:
        key: of the episodes; they never share a draw with learning, even from the same key.
        agents: as `plan` or `load` returns them.
        env: the world; by default that of the agents.
        params: its parameters; by default those that were learned with.
        c: the danger that an episode may have, for agents that carry a budget; by default what
            they learned with.
        episodes: of each agent.
        penalty: taken off the returns per unit of danger.
        name: of this world or these parameters, for the table.
        folder: where checkpoints are kept meanwhile; the same call goes on after an interruption.
        devices: "one", "all" or "cluster" (docs/devices.md).
        on_progress: called with (stage, done, total, note).

    Returns:
        A row per agent: returns with 95 % intervals, crashes with exact ones. Where danger was
        promised, `promised`, and `booked_mean`, the danger of an episode by the agent's account.

    Raises:
        ValueError: a setting is out of range, or the agents cannot act in this world.
        FloatingPointError: an observation, a threat or a reward is not a finite number.
    """
    random_key("key", key)
    number("episodes", episodes, least=1, integer=True)
    number("penalty", penalty, least=0)
    one_of("devices", devices, sharing.DEVICES)
    several = checked_agents(agents).in_world(env, params, c)
    pmdp = several.pmdp
    players = Players(several.members, several.methods, greedily(several.network), several.weights)
    stage = f"evaluation {name}".strip()
    where = None if folder is None else path("folder", folder)
    job = {} if where is None else {**spec_of(key, several), "episodes": episodes}
    with record.job(where, stage, job) as checkpoints:
        rows = play_all(key, pmdp, players, episodes, stage, devices, on_progress, checkpoints)
    checksum = "" if several.threat is None else several.threat.checksum[:12]
    about = {"env": record.short_name(pmdp.env), "variant": name, "threat": checksum}
    return Table(scored(rows, pmdp, players, penalty, about))


def spec_of(key: Array, agents: Agents) -> dict[str, Any]:
    """Returns what the episodes of agents depend on, but for their number.

    Args:
        key: of the episodes.
        agents: in the world that they are played in.
    """
    pmdp = agents.pmdp
    return {
        "env": record.name_of(pmdp.env),
        "key": record.key_data(key),
        "params": record.digest_of(pmdp.params),
        "agents": record.digest_of((agents.weights, pmdp.threats, pmdp.correction)),
        "members": [member._asdict() for member in agents.members],
        "network": agents.config.network,
        "lookahead": pmdp.lookahead,
        "shielded": pmdp.shielded,
        **record.machine(pmdp.env),
    }


def checked_agents(agents: Any) -> Agents:
    """Returns agents, or says what to give in their place.

    Args:
        agents: what the user gave.

    Raises:
        ValueError: they are no `Agents`.
    """
    if isinstance(agents, Agents):
        return agents
    given = "one Agent" if isinstance(agents, Agent) else shown(agents)
    raise ValueError(
        f"agents is {given}; it must be Agents, as plan or load returns them; one of them alone is "
        "agents[0:1]"
    )


class Players(NamedTuple):
    """Who plays: policies of any kind that differ in their weights."""

    members: Sequence[Member]
    names: Sequence[str]  # of their methods
    policy: Callable[[Any], Policy]  # from the weights of one of them
    weights: Any  # leading axis (n,)


def greedily(network: nn.Module) -> Callable[[Any], Policy]:
    """Returns the policy of a Q-network's weights: greedy inside the admissible set.

    Args:
        network: of the action values.
    """
    return lambda weights: evaluation.shielded(evaluation.action_values(network, weights))


def play_all(
    key: Array,
    pmdp: PMDP,
    players: Players,
    episodes: int,
    stage: str = "evaluation",
    devices: str = "one",
    on_progress: OnProgress = silent,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> evaluation.Episodes:
    """Plays episodes of all players side by side, a round of each after another.

    Args:
        key: of the episodes; players with one number play the same ones.
        pmdp: what they play in, but for their own thresholds.
        players: (n,) of them.
        episodes: of each.
        stage: named in the progress.
        devices: "one", "all" or "cluster".
        on_progress: called with (stage, done, total, note).
        checkpoints: of the rounds.

    Returns:
        Rows with leading axes (n, episodes).
    """
    several, axes = side_by_side(pmdp, players.members)
    count, batch = len(players.members), min(ROUND, episodes)

    def one(key: Array, weights: Any, pmdp: PMDP) -> evaluation.Episodes:
        return evaluation.play_round(key, pmdp, players.policy(weights), batch)

    mesh, places = sharing.mesh_of(devices), (0, 0, axes)
    everyone = jax.jit(sharing.sharded_vmap(one, places, mesh))
    numbers = [member.seed for member in players.members]
    keys = numbered(key_of(key, Stream.EVALUATION), numbers)
    each = jax.vmap(lambda key: evaluation.round_keys(key, episodes, batch))(keys)
    rounds = each.shape[1]

    def play(turn: int, found: evaluation.Episodes) -> evaluation.Episodes:
        begun = f"{turn * batch * count:,} of {rounds * batch * count:,} episodes"
        on_progress(stage, turn, rounds, begun)
        given = sharing.shard_arguments((each[:, turn], players.weights, several), places, mesh)
        new = jax.tree.map(np.asarray, sharing.gather(everyone(*given), mesh))
        evaluation.check(new, stage)
        for whole, part in zip(jax.tree.leaves(found), jax.tree.leaves(new), strict=True):
            whole[:, turn * batch : (turn + 1) * batch] = part
        on_progress(stage, turn + 1, rounds, "")
        return found

    shapes = jax.eval_shape(everyone, each[:, 0], players.weights, several)
    blank = jax.tree.map(lambda s: np.zeros((count, rounds * batch), s.dtype), shapes)
    found = checkpoints.loop(blank, play, rounds)
    return jax.tree.map(lambda a: a[:, :episodes], found)


def scored(
    rows: evaluation.Episodes,
    pmdp: PMDP,
    players: Players,
    penalty: float,
    about: Mapping[str, Any],
) -> list[dict[str, Any]]:
    """Returns a row of facts per player.

    Args:
        rows: of their episodes, leading axes (n, episodes).
        pmdp: what they played in.
        players: (n,) of them.
        penalty: taken off the returns per unit of danger.
        about: facts that all rows begin with.
    """
    found = []
    for i, member in enumerate(players.members):
        of = evaluation.summarise(jax.tree.map(lambda a, i=i: a[i], rows), penalty)
        if optional.has_budget(pmdp.env):
            of |= account(jax.tree.map(lambda a, i=i: a[i], rows), pmdp.params)
        x = member.x if pmdp.shielded else float("inf")
        who = {"method": players.names[i], "x": x, "seed": member.seed}
        found.append({**about, **who, **of})
    return found


def account(rows: evaluation.Episodes, params: Any) -> dict[str, Any]:
    """Returns what episodes with a budget spent by their own account.

    Args:
        rows: arrays (n,).
        params: of the world, with the range of c.
    """
    booked, width = statistics.mean_interval(np.asarray(rows.booked))
    return {"promised": float(params.high), "booked_mean": booked, "booked_ci95": width}


@dataclass(frozen=True)
class Timing:
    """How long decisions take, one after another."""

    wall: float  # seconds
    cpu: float  # seconds, of all cores


def timed(
    key: Array, env: Env, params: Any, act: Callable[[Any], Array], actions: int = 100
) -> Timing:
    """Measures decisions, each in the state that the one before it led to.

    Args:
        key: of the environment.
        env: the environment.
        params: its parameters.
        act: from a state to an action; called once before, to compile.
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
    return Timing(float(seconds[0]), float(seconds[1]))


def acting(pmdp: PMDP, policy: Callable[[Any], Policy], weights: Any) -> Callable[[Any], Array]:
    """Returns what chooses an action in a state, observation and threat included; compiled.

    Args:
        pmdp: what it acts in.
        policy: from weights.
        weights: of the policy.
    """

    @jax.jit
    def act(state: Any, weights: Any, pmdp: PMDP) -> Array:
        percept = pmdp.perceive(jax.tree.map(lambda a: a[None], state))
        return policy(weights)(jax.random.key(0), percept)[0][0]

    return lambda state: act(state, weights, pmdp)


def time_agents(key: Array, agents: Agents) -> float:
    """Returns the seconds that 100 decisions of the first agent take.

    Args:
        key: of the environment.
        agents: of one size.
    """
    pmdp = with_member(agents.pmdp, agents.members[0])
    first = jax.tree.map(lambda a: a[0], agents.weights)
    act = acting(pmdp, greedily(agents.network), first)
    return timed(key_of(key, Stream.TIMING), pmdp.env, pmdp.params, act).wall
