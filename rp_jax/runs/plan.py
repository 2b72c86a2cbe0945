"""Planning as a job: agents learn side by side inside the admissible set (Algorithms 3 and 4)."""

import dataclasses
import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from rp_jax import devices as sharing
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints, equal_chunks
from rp_jax.envs import optional
from rp_jax.envs.check import check_contract
from rp_jax.envs.contract import Env
from rp_jax.planning import budgeted, loop
from rp_jax.planning.loop import LoopConfig, LoopState
from rp_jax.planning.networks import POOLS
from rp_jax.planning.pmdp import PMDP
from rp_jax.runs import record, saved, training
from rp_jax.runs.agents import Agents, Member, side_by_side
from rp_jax.runs.progress import OnMetrics, OnProgress, silent
from rp_jax.shield import threshold_array
from rp_jax.streams import Stream, key_of, numbered
from rp_jax.threat import artefact
from rp_jax.threat.function import ThreatFunction
from rp_jax.validate import number, one_of, path, random_key, shown

Several = float | Sequence[float]


def plan(
    key: Array,
    env: Env,
    params: Any,
    threat: ThreatFunction | None = None,
    *,
    c: float | Sequence[float] | None = None,
    x: Several | None = None,
    seeds: int | Sequence[int] = 1,
    config: LoopConfig | None = None,
    lookahead: int = 0,
    refunds: int = 8,
    learning_penalty: Several = 0.0,
    learning_penalty_from: float | None = None,
    insecure_penalty: float = 0.0,
    penalty: float = 0.0,
    folder: str | Path | None = None,
    settings: Mapping[str, Any] | None = None,
    devices: str = "one",
    on_progress: OnProgress = silent,
    on_metrics: OnMetrics = silent,
) -> Agents:
    """Learns to earn reward while taking admissible actions only (Algorithm 2, line 3).

    Several agents learn side by side in one program: one for each of `seeds`, and for each
    threshold or penalty where there are several.

    Args:
        key: of everything random in it; agent i's randomness does not depend on the other agents.
        env: the world, `rp_jax.envs.contract.Env`.
        params: its parameters while learning.
        threat: what `reconnoitre` returned, for a world with the same body and hazards; None: no
            action is forbidden.
        c: the danger that an episode may have, or the least and the greatest that one agent is to
            serve: then each episode of learning draws its own, and `evaluate` may ask for any. The
            agent carries a budget and keeps c while it learns, too (docs/budgets.md).
        x: largest admissible threat of each single step, or several: the paper's rule where no c is
            given, .01 by default; beside c, a cap, and none by default.
        seeds: how many agents, or their numbers.
        config: of the learner; tuned settings by default.
        refunds: outcomes of the action taken by which its danger is booked, where there is a c; 0:
            its threat is booked, which is more, so that less of c is used.
        lookahead: outcomes of each action that are looked at where no action is admissible by the
            threats of the state alone; 0: none.
        learning_penalty: taken off the reward per unit of danger while learning, or several.
        learning_penalty_from: what the penalty begins with; it grows until half-way.
        insecure_penalty: taken off the reward per state reached in which no action is admissible.
        penalty: taken off the returns in the history, per unit of danger; nothing is learned of it.
        folder: created if missing, where the agents, their threat function, their curves and,
            while they learn, checkpoints are kept: the same call goes on where it was interrupted,
            and returns at once what is finished. Agents or a threat function that another call
            left there are an error.
        settings: keywords of `env.make_params` that made the parameters, kept in the folder so that
            the agents can be loaded without them.
        devices: "one", "all" or "cluster" (docs/devices.md).
        on_progress: called with (stage, done, total, note).
        on_metrics: called with a row of facts per chunk and agent.

    Raises:
        ValueError: a setting is out of range, the world breaks the contract, the threat function
            holds for another, or the folder holds something else; before any work.
        FloatingPointError: something that was seen or learned is not a finite number.
    """
    random_key("key", key)
    config = LoopConfig() if config is None else config
    if not isinstance(config, LoopConfig):
        raise ValueError(f"config is {shown(config)}; it must be a LoopConfig")
    config.validate("config")
    one_of("devices", devices, sharing.DEVICES)
    promised = promised_of(c, x, threat)
    members = members_of(caps_of(c, x), learning_penalty, seeds)
    mesh = sharing.mesh_of(devices)
    sharing.divides("agents", len(members), mesh)
    if learning_penalty_from is not None:
        number("learning_penalty_from", learning_penalty_from, least=0)
    number("penalty", penalty, least=0)
    check_contract(env, params)
    pmdp = make_pmdp(
        env,
        params,
        threat,
        x=members[0].x,
        learning_penalty=members[0].learning_penalty,
        insecure_penalty=insecure_penalty,
        lookahead=lookahead,
        config=config,
    )
    if promised is not None:
        pmdp = with_promise(pmdp, promised, refunds)
        check_promise(pmdp, promised[0])
    spec = {
        "env": record.name_of(env),
        "key": record.key_data(key),
        "members": [member._asdict() for member in members],
        "config": config,
        "lookahead": lookahead,
        **({} if promised is None else {"c": list(promised), "refunds": refunds}),
        "learning_penalty_from": learning_penalty_from,
        "insecure_penalty": insecure_penalty,
        "penalty": penalty,
        "params": record.digest_of(params),
        "threat": None if threat is None else record.digest_of((threat.models, threat.correction)),
    }
    where = None if folder is None else path("folder", folder)
    if where is not None and threat is not None:
        _same_threat(where, threat)
    if where is not None and (where / saved.AGENTS / "manifest.json").exists():
        return _finished(where, pmdp, threat, record.plain(spec))
    with record.job(where, "plan", {**spec, **record.machine(env)}) as checkpoints:
        learner = Training(
            pmdp, members, config, penalty, learning_penalty_from, where, on_progress, on_metrics
        )
        keys = numbered(key_of(key, Stream.PLANNING), [member.seed for member in members])
        agents = dataclasses.replace(learned(keys, learner, mesh, checkpoints), threat=threat)
        if where is not None:
            facts = {"spec": record.plain(spec), "settings": dict(settings or {})}
            saved.save_agents(where, agents, facts)
    return agents


def _same_threat(folder: Path, threat: ThreatFunction) -> None:
    """Raises ValueError if a folder holds another threat function."""
    place = folder / saved.THREAT
    if (place / "manifest.json").exists():
        there, wanted = artefact.saved_checksum(place), threat.checksum
        if there != wanted:
            raise ValueError(
                f"folder is {folder}; it holds a threat function with the checksum {there[:16]}; "
                f"it must be new, empty, or hold the one that is given, with {wanted[:16]}"
            )


def promised_of(
    c: float | Sequence[float] | None, x: Several | None, threat: ThreatFunction | None
) -> tuple[float, float] | None:
    """Returns the least and the greatest danger that are promised, checked; None for no promise.

    Args:
        c: the danger of an episode, or a range of it.
        x: cap on each step.
        threat: the threat function, without which nothing can be promised.

    Raises:
        ValueError: c is no danger, no range, or contradicts x or the lack of threats.
    """
    if c is None:
        return None
    values = list(c) if isinstance(c, Sequence) else [c, c]
    if len(values) != 2:
        raise ValueError(f"c has {len(values)} values; it must be a number, or the two of a range")
    for value in values:
        number("c", value, above=0)
    if values[0] > values[1]:
        raise ValueError(f"c is {shown(c)}; the first number must not be greater than the second")
    if threat is None:
        raise ValueError(f"c is {shown(c)}, but there is no threat; one must be given to keep c")
    if x is not None and any(value == float("inf") for value in _listed(x)):
        raise ValueError(f"x is {shown(x)}, which forbids nothing; beside c it must be finite")
    return float(values[0]), float(values[1])


def caps_of(c: Any, x: Several | None) -> Several:
    """Returns the thresholds of single steps: by default .01, or none where there is a budget.

    Args:
        c: danger promised, or None.
        x: what was asked for.
    """
    if x is not None:
        return x
    return 0.01 if c is None else float("inf")


def with_promise(pmdp: PMDP, promised: tuple[float, float], refunds: int) -> PMDP:
    """Returns a P-MDP whose episodes carry a budget of danger.

    Args:
        pmdp: without one.
        promised: least and greatest danger c of an episode.
        refunds: outcomes by which the danger of a chosen action is booked.

    Raises:
        ValueError: a number is out of range.
    """
    number("refunds", refunds, least=0, most=10_000, integer=True)
    env, params = budgeted.with_budget(pmdp.env, pmdp.params, *promised)
    return pmdp.replace(env=env, params=params, refunds=refunds)


def check_promise(pmdp: PMDP, c: float, starts: int = 256) -> None:
    """Raises ValueError if already the least danger of the starts is greater than c on average.

    Args:
        pmdp: whose episodes carry a budget.
        c: the danger that is promised.
        starts: how many are drawn.

    Raises:
        ValueError: the threats leave more danger than c; the message says how much.
    """
    keys = jax.random.split(key_of(jax.random.key(0), Stream.STARTS), starts)
    least = float(jnp.mean(_least_at_starts(keys, pmdp)))
    if least > c:
        raise ValueError(
            f"c is {c:g}; it must be {least:.2g} or more: so much danger do the threats leave at "
            f"the starts of this world on average (of {starts}), whatever the agent does"
        )


@jax.jit
def _least_at_starts(keys: Array, pmdp: PMDP) -> Array:
    states = jax.vmap(pmdp.env.reset, (0, None))(keys, pmdp.params)
    return jnp.minimum(jnp.min(pmdp.threat(states), axis=-1), 1.0)


def members_of(
    x: Several, learning_penalty: Several, seeds: int | Sequence[int]
) -> tuple[Member, ...]:
    """Returns the agents that learn side by side: one per case and seed.

    Args:
        x: threshold, or several.
        learning_penalty: or several; where both are several, they are paired.
        seeds: how many, or their numbers.

    Raises:
        ValueError: a value is out of range, or as many thresholds as penalties are not given.
    """
    if isinstance(seeds, int):
        number("seeds", seeds, least=1, most=1000, integer=True)
    numbers = list(range(seeds)) if isinstance(seeds, int) else list(seeds)
    for seed in numbers:
        number("seeds", seed, least=0, most=2**31 - 1, integer=True)
    if len(set(numbers)) < len(numbers):
        raise ValueError(f"seeds is {shown(numbers)}; each must be there once")
    thresholds, penalties = _listed(x), _listed(learning_penalty)
    if not (numbers and thresholds and penalties):
        raise ValueError("x, learning_penalty and seeds must each have at least one value")
    if len(thresholds) > 1 and len(penalties) > 1 and len(thresholds) != len(penalties):
        raise ValueError(
            f"learning_penalty has {len(penalties)} values; it must have 1, or {len(thresholds)} "
            "as x has"
        )
    for value in thresholds:
        number("x", value, least=0, infinite=True)
    for value in penalties:
        number("learning_penalty", value, least=0)
    count = max(len(thresholds), len(penalties))
    cases = list(
        itertools.islice(zip(itertools.cycle(thresholds), itertools.cycle(penalties)), count)
    )
    return tuple(Member(int(s), float(x), float(p)) for x, p in cases for s in numbers)


def _listed(value: Several) -> list[float]:
    return list(value) if isinstance(value, Sequence) else [value]


def make_pmdp(
    env: Env,
    params: Any,
    threat: ThreatFunction | None,
    *,
    x: float = 0.01,
    learning_penalty: float = 0.0,
    insecure_penalty: float = 0.0,
    lookahead: int = 0,
    config: LoopConfig | None = None,
) -> PMDP:
    """Returns the P-MDP of a world (equation 10), checked.

    Args:
        env: the world.
        params: its parameters.
        threat: its threat function; None: no action is forbidden.
        x: largest admissible threat.
        learning_penalty: taken off the reward per unit of danger while learning.
        insecure_penalty: taken off it per state reached without an admissible action.
        lookahead: outcomes looked at where no action is admissible.
        config: of the learner, whose network says how many LIDAR bins are seen as one.

    Raises:
        ValueError: a number is out of range, or the threat function holds for another world.
    """
    number("x", x, least=0, infinite=True)
    number("learning_penalty", learning_penalty, least=0)
    number("insecure_penalty", insecure_penalty, least=0)
    number("lookahead", lookahead, least=0, most=10_000, integer=True)
    if threat is not None:
        if not isinstance(threat, ThreatFunction):
            raise ValueError(f"threat is {type(threat).__name__}; it must be a ThreatFunction")
        threat.check_fits(env.sub_rmdps(params))
    pool, bins = POOLS[(config or LoopConfig()).network], optional.lidar_bins(env)
    if bins % pool:
        raise ValueError(f"LIDAR_BINS is {bins}; it must be a multiple of {pool}")
    return PMDP(
        params=params,
        threats={} if threat is None else dict(threat.models),
        correction=None if threat is None else threat.correction,
        x=threshold_array(x),
        penalty=jnp.asarray(learning_penalty, float),
        insecure_penalty=jnp.asarray(insecure_penalty, float),
        env=env,
        pool=pool,
        lookahead=lookahead,
        shielded=threat is not None,
    )


def _finished(
    folder: Path, pmdp: PMDP, threat: ThreatFunction | None, spec: Mapping[str, Any]
) -> Agents:
    """Agents that learned before, by the same call."""
    about = saved.about_agents(folder)
    record.compared(f"folder is {folder}", about.get("spec") or {}, spec)
    return saved.restored_agents(folder, about, pmdp, threat)


class Training(NamedTuple):
    """Agents that learn side by side, their world, and where their progress is told."""

    pmdp: PMDP
    members: Sequence[Member]
    config: LoopConfig
    penalty: float
    learning_penalty_from: float | None
    folder: Path | None
    on_progress: OnProgress
    on_metrics: OnMetrics

    def during(self, pmdp: PMDP, share: float) -> PMDP:
        """Returns `pmdp` with the penalty of the moment (appendix G.2).

        Args:
            pmdp: of all agents.
            share: of the learning that is over.
        """
        begin = self.learning_penalty_from
        if begin is None:
            return pmdp
        return pmdp.replace(penalty=begin + min(1.0, 2 * share) * (pmdp.penalty - begin))


class Programs(NamedTuple):
    """Compiled programs, for all agents side by side."""

    begin: Callable[..., LoopState]  # (keys, pmdp): as `loop.begin`
    chunk: Callable[..., tuple[LoopState, loop.LoopMetrics]]  # (state, pmdp, iterations, updates)
    emptied: Callable[[LoopState], LoopState]  # as `loop.emptied`


def compiled(
    keys: Array, pmdp: PMDP, axes: PMDP, config: LoopConfig, mesh: Mesh | None
) -> Programs:
    """Compiles the learner; the second program fills the replay and learns.

    Args:
        keys: (n,) one per agent.
        pmdp: of all agents.
        axes: its `in_axes`.
        config: of the learner.
        mesh: devices that share the agents; None for one.
    """

    def first(key: Array, pmdp: PMDP) -> LoopState:
        return loop.begin(key, pmdp, config)

    def onward(state: LoopState, pmdp: PMDP, iterations: Array, updates: Array):
        return loop.chunk(state, pmdp, config, iterations, updates)

    def empty(state: LoopState) -> LoopState:
        return loop.emptied(state, config)

    begin = jax.jit(sharing.sharded_vmap(first, (0, axes), mesh))
    chunk = jax.jit(sharing.sharded_vmap(onward, (0, axes, None, None), mesh), donate_argnums=0)
    shapes = sharing.sharded_shapes(jax.eval_shape(begin, keys, pmdp), mesh)
    return Programs(
        begin=begin.lower(keys, pmdp).compile(),
        chunk=chunk.lower(shapes, pmdp, config.iterations, config.updates).compile(),
        emptied=jax.jit(sharing.sharded_vmap(empty, (0,), mesh)),
    )


def learned(keys: Array, learner: Training, mesh: Mesh | None, checkpoints: Checkpoints) -> Agents:
    """Trains all agents as one program, chunk by chunk.

    Args:
        keys: (n,) one per agent.
        learner: who learns, and in what.
        mesh: devices that share the agents; None for one.
        checkpoints: of the learning.

    Raises:
        FloatingPointError: something that was seen or learned is not a finite number.
    """
    config, members = learner.config, learner.members
    chunks, length = equal_chunks(config.learning, training.CHUNKS)
    network = loop.make_network(config, learner.pmdp)
    pmdp, axes = side_by_side(learner.pmdp, members)
    keys, pmdp = sharing.shard_arguments((keys, pmdp), (0, axes), mesh)
    learner.on_progress("planning", 0, chunks, "compiling")
    began = time.perf_counter()
    programs = compiled(keys, pmdp, axes, config, mesh)
    compilation = time.perf_counter() - began

    def step(i: int, state: LoopState) -> tuple[LoopState, dict[str, Any]]:
        here = sharing.shard(state, mesh)
        now = learner.during(pmdp, i / chunks)
        state, metrics = programs.chunk(here, now, length, config.updates)
        return state, sharing.gather(metrics, mesh)._asdict()

    def check(params: Any, metrics: dict[str, Any]) -> None:
        loop.check(sharing.gather(params, mesh), loop.LoopMetrics(**metrics))

    def more(sums: Mapping[str, float]) -> dict[str, Any]:
        return {
            "insecure": sums["insecure"] / sums["steps"],
            "inadmissible": int(sums["inadmissible"]),
            "loss": sums["loss"] / (length * config.updates),
        }

    state, filled = _filled(programs, keys, learner.during(pmdp, 0.0), config)
    agents = Agents(learner.pmdp, network, None, tuple(members), config)
    weights, rows, seconds = training.learn(
        training.Learners(
            members,
            agents.methods,
            learner.penalty,
            learner.folder,
            learner.on_progress,
            learner.on_metrics,
            more,
        ),
        state,
        _counted(sharing.gather(filled, mesh), chunks),
        step,
        check,
        lambda state: state.learner.params,
        checkpoints if sharing.one_process() else NO_CHECKPOINTS,
    )
    return dataclasses.replace(
        agents,
        weights=sharing.gather(weights, mesh),
        history=rows,
        seconds={"planning": seconds, "planning_compilation": compilation},
    )


def _filled(
    programs: Programs, keys: Array, pmdp: PMDP, config: LoopConfig
) -> tuple[LoopState, loop.LoopMetrics]:
    """As `loop.init`, by compiled programs."""
    state, opening = programs.chunk(programs.begin(keys, pmdp), pmdp, config.opening, 0)
    state, filled = programs.chunk(programs.emptied(state), pmdp, config.filling, 0)
    return state, jax.tree.map(jnp.add, opening, filled)


def _counted(filled: loop.LoopMetrics, chunks: int) -> dict[str, np.ndarray]:
    """(chunks, n) by name: what filled the replay belongs to the first chunk."""
    metrics = {}
    for name, part in filled._asdict().items():
        metrics[name] = np.zeros((chunks, *part.shape), part.dtype)
        metrics[name][0] = part
    return metrics
