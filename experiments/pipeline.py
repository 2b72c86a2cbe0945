"""The main job, task by task: reconnaissance, threat models, planning, evaluation, figures."""

import dataclasses
import datetime
import functools
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

import rp_jax
from experiments import console, tables, training
from experiments.training import Member, Trained
from rp_jax import devices, evaluate, storage
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints
from rp_jax.envs.base import BASELINES, Env
from rp_jax.planning import loop
from rp_jax.planning.loop import LoopConfig
from rp_jax.planning.networks import POOLS
from rp_jax.planning.pmdp import PMDP
from rp_jax.recon import labels
from rp_jax.threat import artefact, build, report
from rp_jax.threat.build import ThreatConfig
from rp_jax.threat.total import total_threat
from rp_jax.validate import number, one_of

# Streams of random numbers, apart.
THREAT, SUMS, PLANNING, EVALUATION, STARTS, MEDIA, CERTIFICATE, RARE = range(8)


@dataclass(frozen=True)
class Config:
    """Settings that all tasks share."""

    seeds: int = 1  # training runs, side by side in one program
    seed: int = 0  # of the first; the others count up
    out: Path | None = None  # folder for results; default: results/ENV-PRESET-TIME
    threat: Path | None = None  # folder of a threat function to use again
    x: float = 0.01  # largest admissible threat; inf switches the shield off
    learning_penalty: float = 0.0  # taken off the reward per unit of danger while learning
    learning_penalty_from: float | None = None  # at first; it gets there by half-way
    learning_toll: float = 0.0  # likewise, per state without an admissible action
    penalty: float = 50.0  # taken off the return per unit of danger in the tables
    episodes: int = 10_000  # evaluated per case
    devices: str = "one"  # "all": seeds side by side on every device; "cluster": of every process
    figures: bool = True  # draw figures and an animation
    planning: LoopConfig = field(default_factory=LoopConfig)  # the learner
    fidelity: str = "released"  # "released" as the published numbers, "paper" as the text
    baseline: str = "paper"  # "paper": at random; "plans": braking and evading, walls jointly
    lookahead: int = 0  # outcomes of each action looked at where none is admissible

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        number("seeds", self.seeds, least=1, most=1000, integer=True)
        number("seed", self.seed, least=0, most=2**31 - 1001, integer=True)
        number("x", self.x, least=0, infinite=True)
        number("learning_penalty", self.learning_penalty, least=0)
        if self.learning_penalty_from is not None:
            number("learning_penalty_from", self.learning_penalty_from, least=0)
        number("learning_toll", self.learning_toll, least=0)
        number("penalty", self.penalty, least=0)
        number("episodes", self.episodes, least=1, integer=True)
        one_of("devices", self.devices, devices.DEVICES)
        one_of("fidelity", self.fidelity, ("released", "paper"))
        one_of("baseline", self.baseline, BASELINES)
        number("lookahead", self.lookahead, least=0, most=10_000, integer=True)
        self.planning.validate("planning")


class Task(NamedTuple):
    """What distinguishes one task from another: data, and how to draw it."""

    name: str
    env: Env
    train: Any  # environment parameters
    tests: dict[str, Any]  # by variant, environment parameters
    threats: dict[str, ThreatConfig]  # by kind of hazard
    draw: Callable[[Any], None] | None  # makes the task's own figures from a `Finished`


class Finished(NamedTuple):
    """A run, for drawing."""

    task: Task
    config: Any  # the task's own Config
    pmdp: PMDP
    trained: Trained
    rows: list[dict[str, Any]]
    curves: dict[str, list[dict[str, float]]]
    folder: Path  # for figures
    bar: console.Bar


def key_of(seed: int, stream: int) -> jax.Array:
    """The key of one use of a seed; evaluation never shares one with training."""
    return jax.random.fold_in(jax.random.key(seed), stream)


def default_out(task: str, preset: str) -> Path:
    """results/TASK-PRESET-TIME."""
    now = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    return Path("results") / f"{task}-{preset}-{now}"


def learn_threats(
    task: Task, config: Config, folder: Path, checkpoints: Checkpoints = NO_CHECKPOINTS
) -> tuple[dict | None, dict, dict]:
    """The threat models of all kinds of hazard: loaded or learned; and saved in `folder`.

    Returns:
        (models, curves, timings), the latter two empty if loaded; None for no shield.
    """
    subs = task.env.sub_rmdps(task.train)
    if np.isinf(config.x):
        return None, {}, {}
    if not subs:
        return {}, {}, {}
    if config.threat is not None:
        models = artefact.load(config.threat, task.name, subs)
        about = storage.read_manifest(config.threat, artefact.KIND)["about"]
        artefact.save(folder / "threat", task.name, models, subs, about)  # the folder is whole
        return models, {}, {}
    built = {}
    keys = jax.random.split(key_of(config.seed, THREAT), len(subs))
    for key, kind in zip(keys, sorted(subs), strict=True):
        with console.progress(f"threat of {kind}") as bar:
            threat, at = task.threats[kind], checkpoints.at("threat").at(kind)
            mesh = devices.mesh_of(config.devices)
            built[kind] = build.build(key, subs[kind], threat, config.x, bar, mesh, at)
    models = devices.agreed({kind: b.model for kind, b in built.items()})
    reports = {kind: b.report for kind, b in built.items()}
    timings = {kind: b.seconds for kind, b in built.items()}
    sums = sum_reports(key_of(config.seed, SUMS), task, config, models, checkpoints.at("sums"))
    curves = {kind: b.curve for kind, b in built.items()}
    about = {
        "x": config.x,
        "reports": reports,
        "sums": sums,
        "settings": {k: dataclasses.asdict(v) for k, v in task.threats.items()},
        "seed": config.seed,
        "version": rp_jax.__version__,
    }
    artefact.save(folder / "threat", task.name, models, subs, about)
    rows = [{"hazard": kind, "of": "one", **found} for kind, found in reports.items()]
    rows += [{"hazard": kind, "of": "sum", **found} for kind, found in sums.items()]
    tables.show_threats(rows, config.x)
    storage.write_json(folder / "threat" / "report.json", rows)
    storage.write_json(folder / "threat" / "curves.json", curves)
    return models, curves, timings


def sum_reports(
    key: jax.Array,
    task: Task,
    config: Config,
    models: Mapping,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> dict:
    """By kind of hazard, the models' sums against accurate ones on states of the task."""
    walk, *keys = jax.random.split(key, 1 + len(models))
    pmdp = make_pmdp(task, config, models, task.train)
    states = jax.jit(evaluate.visited_states, static_argnums=2)(walk, pmdp, 256)
    hazards = jax.jit(jax.vmap(task.env.hazards, (0, None)))(states, task.train)
    subs = task.env.sub_rmdps(task.train)
    found = {}
    for kind, key in zip(sorted(models), keys, strict=True):
        estimator = labels.best_estimator(subs[kind], task.threats[kind].test_paths)
        with console.progress(f"sum over {kind}s") as bar:
            bar("", 0, 1)
            true = report.labelled_sum(
                key, states.agent, hazards[kind], subs[kind], estimator, checkpoints.at(kind)
            )
            only = {kind: models[kind]}
            said = total_threat(only, states.agent, {kind: hazards[kind]})
            bar("", 1, 1)
        found[kind] = report.compare(np.asarray(said), true, config.x)
    return found


def make_pmdp(task: Task, config: Config, models: Mapping | None, params: Any) -> PMDP:
    """The P-MDP of one variant of the task."""
    return PMDP(
        params=params,
        threats=None if models is None else dict(models),
        x=jnp.asarray(config.x, jnp.float32),
        penalty=jnp.asarray(config.learning_penalty, jnp.float32),
        toll=jnp.asarray(config.learning_toll, jnp.float32),
        env=task.env,
        pool=POOLS[config.planning.network],
        lookahead=config.lookahead,
    )


def members_of(config: Config) -> list[Member]:
    """One for each seed."""
    first, x, penalty = config.seed, config.x, config.learning_penalty
    return [Member(first + i, x, penalty) for i in range(config.seeds)]


def side_by_side(pmdp: PMDP, members: Sequence[Member]) -> tuple[PMDP, PMDP]:
    """The P-MDPs of all members, and the `in_axes` of a vmap over them."""
    x, penalty = (jnp.asarray(v, jnp.float32) for v in zip(*(m[1:] for m in members), strict=True))
    axes = pmdp.replace(params=None, threats=None, x=0, penalty=0, toll=None)
    return pmdp.replace(x=x, penalty=penalty), axes


def keys_of(members: Sequence[Member], stream: int) -> jax.Array:
    """(members,) keys of one use; members of one seed share theirs."""
    return jnp.stack([key_of(member.seed, stream) for member in members])


def method_name(config: Config, member: Member | None = None) -> str:
    """RP with its threshold, or DQN with its penalty."""
    x, penalty = member[1:] if member else (config.x, config.learning_penalty)
    if np.isinf(x):
        return f"DQN (penalty {penalty:g})"
    name = f"RP (x={x:g})" if config.baseline == "paper" else f"RP, plans (x={x:g})"
    return name if penalty == 0 else f"{name[:-1]}, {penalty:g})"


def during(pmdp: PMDP, share: float, config: Config) -> PMDP:
    """`pmdp` with the penalty of the moment when a share of the run is over (appendix G.2)."""
    begin = config.learning_penalty_from
    if begin is None:
        return pmdp
    return pmdp.replace(penalty=begin + min(1.0, 2 * share) * (pmdp.penalty - begin))


def plan(
    task: Task,
    config: Config,
    pmdp: PMDP,
    members: Sequence[Member],
    folder: Path,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> Trained:
    """Trains all members as one program; writes metrics.jsonl as it goes.

    Raises:
        FloatingPointError: something that was seen or learned is not a finite number.
    """
    planning = config.planning
    warm = -(-planning.replay_start // planning.num_envs)  # iterations before learning
    chunks, length = training.chunks_of(max(1, planning.iterations - warm))
    steps = (warm + chunks * length) * planning.num_envs
    keys = keys_of(members, PLANNING)
    names = [method_name(config, member) for member in members]
    methods = list(dict.fromkeys(names))
    console.say(
        f"planning: {len(members)} x {steps:,} steps, {planning.samples_per_step:g} samples "
        f"replayed per step, {'; '.join(methods)}"
    )
    pmdp, axes = side_by_side(pmdp, members)
    mesh = devices.mesh_of(config.devices)
    keys, pmdp = devices.place((keys, pmdp), (0, axes), mesh)

    def more(sums: Mapping[str, float]) -> dict[str, Any]:
        return {
            "insecure": sums["insecure"] / sums["steps"],
            "inadmissible": int(sums["inadmissible"]),
            "loss": sums["loss"] / (length * planning.updates),
        }

    with console.progress("planning") as bar:
        bar("", 0, chunks, "compiling")
        began = time.perf_counter()
        start = functools.partial(loop.begin, config=planning)
        begin = jax.jit(devices.spread(start, (0, axes), mesh))

        def onward(state: loop.LoopState, pmdp: PMDP, iterations: jax.Array, updates: jax.Array):
            return loop.chunk(state, pmdp, planning, iterations, updates)

        # One program fills the replay and learns: its compilation takes longer than all else.
        chunk = jax.jit(devices.spread(onward, (0, axes, None, None), mesh), donate_argnums=0)
        shapes = devices.placed(jax.eval_shape(begin, keys, pmdp), mesh)
        program = chunk.lower(shapes, pmdp, length, planning.updates).compile()
        first = begin.lower(keys, pmdp).compile()
        compiled = time.perf_counter()

        def step(i: int, state: loop.LoopState) -> tuple[loop.LoopState, dict[str, Any]]:
            now = during(pmdp, i / chunks, config)
            state, metrics = program(state, now, length, planning.updates)
            return state, devices.gather(metrics, mesh)._asdict()

        def check(params: Any, metrics: dict[str, Any]) -> None:
            loop.check(devices.gather(params, mesh), loop.Metrics(**metrics))

        state, filled = program(first(keys, pmdp), during(pmdp, 0.0, config), planning.filling, 0)
        metrics = {}
        for name, part in devices.gather(filled, mesh)._asdict().items():
            metrics[name] = np.zeros((chunks, *part.shape), part.dtype)
            metrics[name][0] = part  # what filled the replay belongs to the first chunk
        params, rows, seconds = training.learn(
            training.Learners(members, names, config.penalty, folder, more),
            state,
            metrics,
            step,
            check,
            lambda state: state.learner.params,
            bar,
            checkpoints if mesh is None else NO_CHECKPOINTS,
        )
        params = devices.gather(params, mesh)
    about = {"methods": methods, "members": [member._asdict() for member in members]}
    storage.save(folder / "agent", "Q-network", params, about)
    return Trained(params, rows, seconds, compiled - began)


class Agents(NamedTuple):
    """Who is evaluated."""

    members: Sequence[Member]
    names: Sequence[str]  # of their methods
    policy: Callable[[Any], evaluate.Policy]  # of one member's parameters
    trained: Trained


def evaluate_all(
    task: Task,
    config: Config,
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
        seconds, _ = action_seconds(key_of(config.seed, EVALUATION), task.env, this.params, act)
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
    task: Task, config: Config, pmdp: PMDP, agents: Agents, checkpoints: Checkpoints
) -> tuple[dict[str, PMDP], dict[str, evaluate.Episodes]]:
    """By variant, the members' P-MDPs and their episodes (members, episodes)."""
    pmdp, axes = side_by_side(pmdp, agents.members)
    batch = min(1000, config.episodes)

    def one(key, params, pmdp):
        policy = agents.policy(params)
        return evaluate.play_episodes(key, pmdp, policy, config.episodes, batch=batch)

    mesh, places = devices.mesh_of(config.devices), (0, 0, axes)
    everyone = jax.jit(devices.spread(one, places, mesh))
    keys, params = keys_of(agents.members, EVALUATION), agents.trained.params
    variants = {name: pmdp.replace(params=test) for name, test in task.tests.items()}
    with console.progress(f"{agents.names[0]}, evaluation") as bar:

        def play(i: int, found: dict[str, evaluate.Episodes]) -> dict[str, evaluate.Episodes]:
            name, this = list(variants.items())[i]
            bar("", i, len(variants), f"{name}: {config.episodes:,} episodes a seed")
            given = devices.place((keys, params, this), places, mesh)
            episodes = jax.tree.map(np.asarray, devices.gather(everyone(*given), mesh))
            evaluate.check(episodes, name)
            bar("", i + 1, len(variants))
            return {**found, name: episodes}

        shapes = {name: jax.eval_shape(everyone, keys, params, p) for name, p in variants.items()}
        blank = jax.tree.map(lambda s: np.zeros(s.shape, s.dtype), shapes)
        return variants, checkpoints.loop(blank, play, len(variants))


def plan_and_evaluate(
    task: Task,
    config: Config,
    pmdp: PMDP,
    members: Sequence[Member],
    folder: Path,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> tuple[Trained, list[dict[str, Any]]]:
    """`plan` into a folder, created if missing, then `evaluate_all`."""
    folder.mkdir(exist_ok=True)
    trained = plan(task, config, pmdp, members, folder, checkpoints.at("planning"))
    network = loop.make_network(config.planning, pmdp)
    names = [method_name(config, member) for member in members]
    agents = Agents(members, names, greedily(network), trained)
    return trained, evaluate_all(task, config, pmdp, agents, checkpoints.at("evaluation"))


def greedily(network: nn.Module) -> Callable[[Any], evaluate.Policy]:
    """The policy of a Q-network's weights: greedy inside the admissible set."""
    return lambda weights: evaluate.shielded(evaluate.greedy(network, weights))


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


def checked(make_task: Callable[[Any], Task], config: Config) -> Task:
    """Finds everything that can be wrong with the settings, before any long work.

    Raises:
        ValueError: a setting is out of range, or a file cannot be used.
    """
    config.validate()
    devices.connect(config.devices)
    devices.divides("seeds", config.seeds, devices.mesh_of(config.devices))
    task = make_task(config)
    for kind, threat in task.threats.items():
        threat.validate(kind)
    if config.threat is not None:
        artefact.load(config.threat, task.name, task.env.sub_rmdps(task.train))
    return task


def prepare(make_task: Callable[[Any], Task], config: Config, preset: str) -> tuple[Task, Path]:
    """`checked`, and the new folder for the results.

    Raises:
        ValueError: a setting is out of range, or a file or the folder cannot be used.
    """
    task = checked(make_task, config)
    if not devices.is_first():  # what the others write is thrown away
        return task, Path(tempfile.mkdtemp())
    return task, storage.new_folder(config.out or default_out(task.name, preset))


def run(task: Task, config: Config, folder: Path, checkpoints: Checkpoints) -> None:
    """The whole job, into a folder that has its config.json."""
    began = time.perf_counter()
    models, curves, parts = learn_threats(task, config, folder, checkpoints)
    reconnaissance = time.perf_counter() - began
    pmdp, members = make_pmdp(task, config, models, task.train), members_of(config)
    trained, rows = plan_and_evaluate(task, config, pmdp, members, folder, checkpoints)
    tables.write(folder, rows)
    summary = {
        "steps": sum(row["steps"] for row in trained.history[-config.seeds :]),
        "crashes": sum(row["crashes"] for row in trained.history),
        "episodes": sum(row["episodes"] for row in trained.history),
        "inadmissible": sum(row["inadmissible"] for row in trained.history),
        "seconds": {
            "reconnaissance": reconnaissance,
            "reconnaissance_parts": parts,
            "planning": trained.seconds,
            "planning_compilation": trained.compile_seconds,
            "total_before_figures": time.perf_counter() - began,
        },
    }
    storage.write_json(folder / "training.json", summary)
    console.say(
        f"training: {summary['steps']:,} steps, {summary['crashes']} crashes in "
        f"{summary['episodes']:,} episodes, {summary['inadmissible']} inadmissible actions "
        f"taken; {trained.seconds:.1f} s after {trained.compile_seconds:.1f} s of compilation"
    )
    if config.figures and task.draw is not None:
        figures = folder / "figures"
        figures.mkdir(exist_ok=True)
        with console.progress("figures") as bar:
            task.draw(Finished(task, config, pmdp, trained, rows, curves, figures, bar))
    console.say(f"results: {folder}")
