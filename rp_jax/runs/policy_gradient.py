"""Baselines as a job: CPO and PID-Lagrangian PPO, which learn without a threat function."""

import dataclasses
import functools
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jax import Array

import rp_jax
from rp_jax import storage
from rp_jax.baselines import actor_critic, cpo, pid_lagrangian
from rp_jax.baselines.cpo import CPOConfig
from rp_jax.baselines.pid_lagrangian import PIDConfig
from rp_jax.baselines.policies import CONTROLS
from rp_jax.checkpoints import Checkpoints, equal_chunks
from rp_jax.envs.check import check_contract
from rp_jax.envs.contract import Env
from rp_jax.planning.pmdp import PMDP
from rp_jax.rollout import Policy
from rp_jax.runs import record, saved, training
from rp_jax.runs.agents import Member
from rp_jax.runs.evaluate import Players, Timing, acting, play_all, scored, timed
from rp_jax.runs.plan import make_pmdp, members_of
from rp_jax.runs.progress import OnMetrics, OnProgress, silent
from rp_jax.runs.tables import Table
from rp_jax.streams import Stream, key_of, numbered
from rp_jax.validate import finite, none_bad, number, one_of, path, random_key, shown

LEARNERS: Mapping[str, Any] = {"CPO": cpo, "PID-Lagrangian": pid_lagrangian}
CONFIGS: Mapping[str, Any] = {"CPO": CPOConfig, "PID-Lagrangian": PIDConfig}
KIND = "actor"  # of the folder that policies are saved in


@dataclass(frozen=True)
class Policies:
    """Policies that one method learned side by side, all under the same constraint."""

    method: str  # CPO or PID-Lagrangian
    c: float  # bound on the danger of an episode
    pmdp: PMDP  # what they learned in, without a shield
    weights: Any  # of the policy networks, leading axis (n,)
    members: tuple[Member, ...]  # (n,)
    config: Any  # of the learner
    history: list[dict[str, Any]] = field(default_factory=list)  # a row per chunk and policy
    seconds: dict[str, float] = field(default_factory=dict)  # of compilation and learning

    def __len__(self) -> int:
        return len(self.members)

    @property
    def players(self) -> Players:
        """The policies as evaluation takes them, each acting by its mode."""
        names = [self.method] * len(self.members)
        return Players(self.members, names, by_mode(self.config, self.pmdp), self.weights)


def by_mode(config: Any, pmdp: PMDP) -> Callable[[Any], Policy]:
    """Returns what makes a policy of a network's weights that always takes the likeliest action.

    Args:
        config: of the learner.
        pmdp: what was learned in.
    """
    network = actor_critic.make_actor(pmdp, config.rollout)
    return lambda weights: actor_critic.driver(network, weights, greedy=True)


def learn_policies(
    key: Array,
    env: Env,
    params: Any,
    method: str,
    *,
    c: float,
    seeds: int | Sequence[int] = 1,
    config: CPOConfig | PIDConfig | None = None,
    steps: int = 1_200_000,
    learning_penalty: float = 0.0,
    penalty: float = 0.0,
    folder: str | Path | None = None,
    on_progress: OnProgress = silent,
    on_metrics: OnMetrics = silent,
) -> Policies:
    """Learns to earn reward while the danger of an episode is at most c, by a policy gradient.

    Several policies learn side by side in one program.

    Args:
        key: of everything random in it; policy i's randomness does not depend on the others.
        env: the world.
        params: its parameters while learning.
        method: "CPO" or "PID-Lagrangian".
        c: bound on the expected danger of an episode, not discounted.
        seeds: how many policies, or their numbers.
        config: of the learner; its own defaults if it is not given.
        steps: of the environment, that each learns in, rounded up to whole batches.
        learning_penalty: taken off the reward per unit of danger while learning.
        penalty: taken off the returns in the history, per unit of danger; nothing is learned of it.
        folder: new or empty, where the policies, their curves and, while they learn, checkpoints
            are kept: the same call goes on where it was interrupted, and returns at once what is
            finished.
        on_progress: called with (stage, done, total, note).
        on_metrics: called with a row of facts per chunk and policy.

    Raises:
        ValueError: a setting is out of range, the world breaks the contract, or the folder holds
            something else; before any work.
        FloatingPointError: something that was seen or learned is not a finite number.
    """
    random_key("key", key)
    kind = CONFIGS[one_of("method", method, LEARNERS)]
    config = kind() if config is None else config
    if not isinstance(config, kind):
        raise ValueError(f"config is {shown(config)}; for {method} it must be a {kind.__name__}")
    config.validate("config")
    number("c", c, least=0)
    number("steps", steps, least=1, integer=True)
    number("penalty", penalty, least=0)
    members = members_of(float("inf"), learning_penalty, seeds)
    check_contract(env, params)
    if config.rollout.policy == "gaussian":
        _check_continuous(key, env, params)
    pmdp = make_pmdp(env, params, None, x=float("inf"), learning_penalty=learning_penalty)
    spec = {
        "env": record.name_of(env),
        "key": record.key_data(key),
        "method": method,
        "c": c,
        "members": [member._asdict() for member in members],
        "config": config,
        "steps": steps,
        "learning_penalty": learning_penalty,
        "penalty": penalty,
        "params": record.digest_of(params),
    }
    where = None if folder is None else path("folder", folder)
    keys = numbered(key_of(key, Stream.POLICY_GRADIENT), [member.seed for member in members])
    policies = Policies(method, c, pmdp, None, members, config)
    if where is not None and (where / saved.AGENTS / "manifest.json").exists():
        return _finished(where, keys, policies, record.plain(spec))
    with record.job(where, method, {**spec, **record.machine(env)}) as checkpoints:
        learners = training.Learners(
            members,
            [method] * len(members),
            penalty,
            where,
            on_progress,
            on_metrics,
        )
        policies = _learned(keys, policies, steps, learners, checkpoints)
        if where is not None:
            about = {
                "method": method,
                "c": c,
                "members": spec["members"],
                "seconds": policies.seconds,
                "spec": record.plain(spec),
                "version": rp_jax.__version__,
            }
            storage.save(where / saved.AGENTS, KIND, policies.weights, about)
    return policies


def _check_continuous(key: Array, env: Env, params: Any) -> None:
    """Raises ValueError unless a world's `step` takes continuous actions."""

    def step(key: Array) -> Any:
        action = jnp.zeros(CONTROLS)
        return env.step(key, env.reset(key, params), action, params)

    try:
        jax.eval_shape(step, key)
    except Exception as error:  # whatever a world raises
        raise ValueError(
            f"config.rollout.policy is 'gaussian'; it must be 'categorical' in "
            f"{record.name_of(env)}, whose step takes no continuous actions "
            f"({CONTROLS},): {type(error).__name__}"
        ) from error


def _finished(folder: Path, keys: Array, policies: Policies, spec: Mapping[str, Any]) -> Policies:
    """Policies that learned before, by the same call."""
    about = storage.read_manifest(folder / saved.AGENTS, KIND)["about"]
    record.compared(f"folder is {folder}", about.get("spec") or {}, spec)
    like = jax.eval_shape(_starting(policies), keys, policies.pmdp)
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return dataclasses.replace(
        policies,
        weights=storage.load(folder / saved.AGENTS, KIND, _learner(like).actor),
        history=[json.loads(line) for line in lines],
        seconds=dict(about.get("seconds") or {}),
    )


def _starting(policies: Policies) -> Callable[[Array, PMDP], Any]:
    """The start of all policies, (keys (n,), P-MDP) -> states (n,)."""
    init = functools.partial(LEARNERS[policies.method].init, config=policies.config)
    return jax.vmap(init, (0, None))


def _learned(
    keys: Array,
    policies: Policies,
    steps: int,
    learners: training.Learners,
    checkpoints: Checkpoints,
) -> Policies:
    """Trains all policies as one program, chunk by chunk."""
    name, config, pmdp = policies.method, policies.config, policies.pmdp
    learner = LEARNERS[name]
    chunks, length = equal_chunks(-(-steps // config.rollout.steps), training.CHUNKS)

    def chunk(state: Any, pmdp: PMDP, c: Array) -> tuple[Any, dict[str, Array]]:
        def one(state: Any, _: None) -> tuple[Any, dict[str, Array]]:
            state, metrics = learner.step(state, pmdp, c, config)
            return state, metrics.rollout._asdict() | _update_facts(metrics)

        state, metrics = jax.lax.scan(one, state, None, length=length)
        return state, jax.tree.map(lambda m: jnp.sum(m, axis=0, dtype=m.dtype), metrics)

    def more(sums: Mapping[str, float]) -> dict[str, Any]:
        counted = actor_critic.ActorCriticMetrics._fields
        return {key: value / length for key, value in sums.items() if key not in counted}

    learners.on_progress(learners.stage, 0, chunks, "compiling")
    began = time.perf_counter()
    state = jax.jit(_starting(policies))(keys, pmdp)
    c = jnp.asarray(policies.c, pmdp.x.dtype)
    jitted = jax.jit(
        jax.vmap(chunk, (0, None, None)),
        donate_argnums=0,
        compiler_options=cpo.compiler_options(),
    )
    improve = jitted.lower(state, pmdp, c).compile()
    compilation = time.perf_counter() - began

    def step(_: int, state: Any) -> tuple[Any, dict[str, Array]]:
        state, metrics = improve(state, pmdp, c)
        counts = {key: metrics[key] for key in actor_critic.ActorCriticMetrics._fields}
        none_bad(name, actor_critic.ActorCriticMetrics(**counts))
        # Not finite, it stops CPO without a word: no step is then accepted.
        critic = _learner(state).critic
        finite(f"{name}: values' weights", jax.flatten_util.ravel_pytree(critic)[0])
        return state, metrics

    def check(weights: Any, metrics: dict[str, Any]) -> None:
        finite(f"{name}: weights", jax.flatten_util.ravel_pytree(weights)[0])
        for key in ("score", "danger"):
            finite(f"{name}: {key}", metrics[key])

    shapes = jax.eval_shape(jitted, state, pmdp, c)[1]
    weights, rows, seconds = training.learn(
        learners._replace(more=more),
        state,
        {key: np.zeros((chunks, *s.shape), s.dtype) for key, s in shapes.items()},
        step,
        check,
        lambda state: _learner(state).actor,
        checkpoints,
    )
    return dataclasses.replace(
        policies,
        weights=weights,
        history=rows,
        seconds={"planning": seconds, "planning_compilation": compilation},
    )


def _learner(state: Any) -> actor_critic.ActorCriticState:
    """Policy and critic, in the state of either method."""
    return state if isinstance(state, actor_critic.ActorCriticState) else state.learner


def _update_facts(metrics: Any) -> dict[str, Array]:
    """What an update of either method did, as numbers to be averaged."""
    if isinstance(metrics, pid_lagrangian.PIDMetrics):
        return {"multiplier": metrics.penalty}
    kl, case, accepted = metrics.update
    return {
        "kl": kl,
        "recoveries": (case == cpo.RECOVERY).astype(kl.dtype),
        "accepted": accepted.astype(kl.dtype),
    }


def evaluate_policies(
    key: Array,
    policies: Policies,
    params: Any = None,
    *,
    episodes: int = 10_000,
    penalty: float = 0.0,
    name: str = "",
    folder: str | Path | None = None,
    devices: str = "one",
    on_progress: OnProgress = silent,
) -> Table:
    """Plays episodes of each policy, without exploring, and says how they do.

    Args:
        key: of the episodes: policies and agents with one number play the same ones.
        policies: as `learn_policies` returns them.
        params: parameters of the world; by default those that were learned with.
        episodes: of each policy.
        penalty: taken off the returns per unit of danger.
        name: of these parameters, for the table.
        folder: where checkpoints are kept meanwhile; the same call goes on after an interruption.
        devices: "one", "all" or "cluster" (docs/devices.md).
        on_progress: called with (stage, done, total, note).

    Returns:
        A row per policy, as `evaluate` has them.

    Raises:
        ValueError: a setting is out of range.
        FloatingPointError: an observation or a reward is not a finite number.
    """
    random_key("key", key)
    number("episodes", episodes, least=1, integer=True)
    number("penalty", penalty, least=0)
    pmdp = policies.pmdp if params is None else policies.pmdp.replace(params=params)
    stage = f"evaluation {name}".strip()
    where = None if folder is None else path("folder", folder)
    spec = {
        "env": record.name_of(pmdp.env),
        "key": record.key_data(key),
        "method": policies.method,
        "params": record.digest_of(pmdp.params),
        "weights": record.digest_of(policies.weights),
        "members": [member._asdict() for member in policies.members],
        "episodes": episodes,
        **record.machine(pmdp.env),
    }
    players = policies.players
    with record.job(where, stage, spec) as checkpoints:
        rows = play_all(key, pmdp, players, episodes, stage, devices, on_progress, checkpoints)
    about = {"env": record.short_name(pmdp.env), "variant": name}
    return Table(scored(rows, pmdp, players, penalty, about))


def time_policies(key: Array, policies: Policies, params: Any = None) -> Timing:
    """Returns how long 100 decisions of the first policy take, one after another.

    Args:
        key: of the environment.
        policies: of one size.
        params: parameters of the world; by default those that were learned with.
    """
    pmdp = policies.pmdp if params is None else policies.pmdp.replace(params=params)
    first = jax.tree.map(lambda a: a[0], policies.weights)
    act = acting(pmdp, policies.players.policy, first)
    return timed(key_of(key, Stream.TIMING), pmdp.env, pmdp.params, act)
