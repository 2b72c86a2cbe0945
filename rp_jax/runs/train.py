"""The whole job for a world: reconnaissance, planning and evaluation, into one folder."""

import dataclasses
import importlib.util
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax

from rp_jax import devices as sharing
from rp_jax import storage
from rp_jax.checkpoints import equal_chunks
from rp_jax.copies import parts
from rp_jax.envs.check import check_contract
from rp_jax.planning.loop import LoopConfig
from rp_jax.runs import record, saved, training
from rp_jax.runs.agents import Agents, check_same_interface
from rp_jax.runs.evaluate import evaluate, time_agents
from rp_jax.runs.plan import make_pmdp, plan
from rp_jax.runs.progress import OnMetrics, OnProgress, silent
from rp_jax.runs.reconnoitre import reconnoitre, settings_of
from rp_jax.runs.tables import Table
from rp_jax.streams import Stream, key_of, numbered
from rp_jax.threat import artefact
from rp_jax.threat.build import ThreatConfig
from rp_jax.threat.function import ThreatFunction, load_threat
from rp_jax.validate import number, one_of, within


def can_draw() -> bool:
    """Returns whether matplotlib is installed, which figures are drawn with."""
    return importlib.util.find_spec("matplotlib") is not None


class World(NamedTuple):
    """An environment, and the settings that it is learned and tested with."""

    name: str
    env: Any  # a module, or an object, with `make_params`
    settings: dict[str, Any]  # keywords of `make_params` while learning
    tests: dict[str, dict[str, Any]]  # by name, keywords of `make_params` while testing

    def __reduce__(self) -> tuple:
        """Returns how a copy is made, which shares the environment."""
        return parts(self)

    def params(self, test: str | None = None) -> Any:
        """Returns the parameters while learning, or those of a test.

        Args:
            test: its name.

        Raises:
            ValueError: there is no such test, or a setting is out of range.
        """
        if test is None:
            return self.env.make_params(**self.settings)
        one_of("variant", test, self.tests)
        with within(f"test {test}"):
            return self.env.make_params(**self.tests[test])


@dataclass(frozen=True)
class TrainConfig:
    """Settings that a run's results depend on, beside its world and threat functions."""

    seeds: int = 1  # agents, side by side in one program
    seed: int = 0  # number of the first; the others count up
    x: float = 0.01  # largest admissible threat; with c, where threats are learned most closely
    c: float | None = None  # danger that an episode may have, in place of x
    refunds: int = 8  # outcomes of the action taken by which its danger is booked, with c
    shield: bool = True  # off: no action is forbidden, as in DQN
    lookahead: int = 0  # outcomes of each action looked at where none is admissible
    learning_penalty: float = 0.0  # taken off the reward per unit of danger while learning
    learning_penalty_from: float | None = None  # at first; it gets there by half-way
    insecure_penalty: float = 0.0  # likewise, per state without an admissible action
    penalty: float = 0.0  # taken off the return per unit of danger in the tables
    episodes: int = 10_000  # evaluated per test and agent
    planning: LoopConfig = field(default_factory=LoopConfig)  # the learner

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        number("seeds", self.seeds, least=1, most=1000, integer=True)
        number("seed", self.seed, least=0, most=2**31 - 1001, integer=True)
        number("x", self.x, least=0, infinite=True)
        if self.c is not None:
            number("c", self.c, above=0)
            if not self.shield:
                raise ValueError("shield is False; with c it must be True")
        number("refunds", self.refunds, least=0, most=10_000, integer=True)
        number("lookahead", self.lookahead, least=0, most=10_000, integer=True)
        number("learning_penalty", self.learning_penalty, least=0)
        if self.learning_penalty_from is not None:
            number("learning_penalty_from", self.learning_penalty_from, least=0)
        number("insecure_penalty", self.insecure_penalty, least=0)
        number("penalty", self.penalty, least=0)
        number("episodes", self.episodes, least=1, integer=True)
        self.planning.validate("planning")


@dataclass(frozen=True)
class Process:
    """How a run is made: nothing that its results depend on."""

    out: Path | None = None  # folder for results; default: results/WORLD-TIME
    threat: Path | None = None  # folder of a threat function to use again
    devices: str = "one"  # "one"; "all": agents on every device; "cluster": of every process
    figures: bool = field(default_factory=can_draw)  # draw figures, with matplotlib


Threatened = TypeVar("Threatened", bound=Any)  # a dataclass with a field `threat`


class RunResult(NamedTuple):
    """A finished run."""

    world: World
    config: TrainConfig
    threat: ThreatFunction | None
    agents: Agents
    table: Table
    folder: Path


def checked(
    world: World,
    config: TrainConfig,
    threats: Mapping[str, ThreatConfig],
    process: Process,
) -> dict[str, Any]:
    """Finds everything that can be wrong with a run, before any long work.

    Args:
        world: what is learned.
        config: of the run.
        threats: settings by kind of hazard; those that the world has not are not used.
        process: how it is made.

    Returns:
        By test, its parameters.

    Raises:
        ValueError: a setting is out of range, the world breaks the contract, or a file cannot be
            used.
    """
    config.validate()
    one_of("devices", process.devices, sharing.DEVICES)
    sharing.connect(process.devices)
    sharing.divides("seeds", config.seeds, sharing.mesh_of(process.devices))
    for kind, threat in threats.items():
        threat.validate(kind)
    if process.threat is not None and not config.shield:
        raise ValueError(
            f"threat is {process.threat}; without a shield it must not be given: nothing goes by it"
        )
    params = world.params()
    if not world.tests:
        raise ValueError("tests is {}; the world must have at least one")
    tests = {name: world.params(name) for name in world.tests}
    check_contract(world.env, params)
    subs = world.env.sub_rmdps(params)
    for name, given in tests.items():
        with within(f"test {name}"):
            check_same_world(world.env, params, given, config.shield)
    settings_of({kind: threats[kind] for kind in subs if kind in threats}, subs)
    if process.threat is not None:
        load_threat(process.threat, subs)
    make_pmdp(world.env, params, None, x=config.x, config=config.planning)
    return tests


def check_same_world(env: Any, params: Any, test: Any, shield: bool) -> None:
    """Raises ValueError unless what learns with some parameters can be tested with others.

    Args:
        env: the world.
        params: its parameters while learning.
        test: its parameters in a test.
        shield: whether agents go by a threat function.

    Raises:
        ValueError: something is seen or done otherwise, or the threats hold for another body,
            baseline policy or hazard.
    """
    check_same_interface((env, params), (env, test))
    if shield:
        found, wanted = env.sub_rmdps(test), env.sub_rmdps(params)
        artefact.same_kinds("hazards of the world", found, wanted)
        for kind, sub in wanted.items():
            artefact.same_sub(kind, found[kind], sub)


def train(
    world: World,
    config: TrainConfig,
    threats: Mapping[str, ThreatConfig],
    folder: Path,
    process: Process = Process(),
    *,
    on_progress: OnProgress = silent,
    on_metrics: OnMetrics = silent,
    say: Callable[[str], None] = print,
) -> RunResult:
    """Learns the threat function of a world, agents that go by it, and evaluates them.

    Args:
        world: what is learned, and how it is tested.
        config: of the run.
        threats: settings by kind of hazard; tuned ones where there are none.
        folder: for the results, which exists; the same call goes on where it was interrupted.
        process: how the run is made.
        on_progress: called with (stage, done, total, note).
        on_metrics: called with a row of facts per chunk of learning and agent.
        say: told what is about to be done.

    Raises:
        ValueError: a setting is out of range, or the folder holds something else.
        FloatingPointError: something that was seen or learned is not a finite number.
    """
    began = time.perf_counter()
    process = with_own_threat(process, folder)
    tests, params = checked(world, config, threats, process), world.params()
    resumed = any((folder / record.CHECKPOINTS).glob("*/")) if folder.is_dir() else False
    key, env, devices = jax.random.key(0), world.env, process.devices
    threat = None
    if config.shield:
        threat = threat_of(key, world, config, threats, folder, process, on_progress)
    explored = time.perf_counter() - began
    numbers = range(config.seed, config.seed + config.seeds)
    say(announced(config, threat, world))
    agents = plan(
        key,
        env,
        params,
        threat,
        c=config.c,
        x=config.x if config.c is None else None,
        seeds=list(numbers),
        config=config.planning,
        lookahead=config.lookahead,
        refunds=config.refunds,
        learning_penalty=config.learning_penalty,
        learning_penalty_from=config.learning_penalty_from,
        insecure_penalty=config.insecure_penalty,
        penalty=config.penalty,
        folder=folder,
        settings=world.settings,
        devices=devices,
        on_progress=on_progress,
        on_metrics=on_metrics,
    )
    table = evaluated(key, world, tests, agents, config, folder, devices, on_progress)
    table.write(folder)
    seconds = {
        "reconnaissance": explored,
        "reconnaissance_parts": {} if threat is None else threat.about.get("seconds", {}),
        **agents.seconds,
        "total_before_figures": time.perf_counter() - began,
    }
    summary = summed_up(agents, seconds) | {"resumed": resumed}
    storage.write_json(folder / "training.json", summary)
    say(
        f"training: {summary['steps']:,} steps, {summary['crashes']} crashes in "
        f"{summary['episodes']:,} episodes, {summary['inadmissible']} inadmissible actions taken"
    )
    return RunResult(world, config, threat, agents, table, folder)


def threat_of(
    key: jax.Array,
    world: World,
    config: TrainConfig,
    threats: Mapping[str, ThreatConfig],
    folder: Path,
    process: Process,
    on_progress: OnProgress,
) -> ThreatFunction:
    """Returns the threat function of a run: one to be used again, or a new one.

    Args:
        key: of everything random in it, together with the run's seed.
        world: what is learned.
        config: of the run.
        threats: settings by kind of hazard.
        folder: of the run, which gets a copy.
        process: names one to be used again.
        on_progress: called with (stage, done, total, note).
    """
    params, place = world.params(), folder / saved.THREAT
    subs = world.env.sub_rmdps(params)
    keep_threat(world, process.threat, folder)
    if process.threat is not None:
        return load_threat(place, subs)
    own = {kind: threats[kind] for kind in subs if kind in threats}
    return reconnoitre(
        numbered(key_of(key, Stream.THREAT), [config.seed])[0],
        world.env,
        params,
        x=config.x if 0 < config.x < 1 else 0.01,
        config=own,
        folder=place,
        devices=process.devices,
        on_progress=on_progress,
    )


def keep_threat(world: World, threat: Path | None, folder: Path) -> None:
    """Copies the threat function that a run uses again into the run's folder, unless it is there.

    A run that is resumed needs the copy alone: it may be called from elsewhere, and the threat
    function that was given may be gone or another one by then.

    Args:
        world: what is learned.
        threat: folder of the threat function; None: there is nothing to copy.
        folder: of the run.

    Raises:
        storage.StorageError: it cannot be read, holds for another world, or cannot be written.
    """
    place = folder / saved.THREAT
    if threat is not None and not (place / "manifest.json").exists():
        found = load_threat(threat, world.env.sub_rmdps(world.params()))
        shutil.rmtree(place, ignore_errors=True)
        found.save(place, record.name_of(world.env))


def with_own_threat(process: Threatened, folder: Path) -> Threatened:
    """Returns how a run is made, with the copy of the threat function in place of the one given.

    Args:
        process: a dataclass with a field `threat`, such as `Process`.
        folder: of the run; as `keep_threat` left it.
    """
    place = folder / saved.THREAT
    if process.threat is None or not (place / "manifest.json").exists():
        return process
    return dataclasses.replace(process, threat=place)


def announced(config: TrainConfig, threat: ThreatFunction | None, world: World) -> str:
    """Returns what is said before planning: who learns, and for how many steps.

    Args:
        config: of the run.
        threat: that the agents go by.
        world: what they learn in.
    """
    loop = config.planning
    chunks, length = equal_chunks(loop.learning, training.CHUNKS)
    steps = (loop.opening - 1 + loop.filling + chunks * length) * loop.num_envs
    limit = f"x = {config.x:g}" if config.c is None else f"c = {config.c:g}"
    shield = "no shield" if threat is None else limit
    return (
        f"planning in {world.name}: {config.seeds} x {steps:,} steps, {loop.samples_per_step:g} "
        f"samples replayed per step, {shield}"
    )


def evaluated(
    key: jax.Array,
    world: World,
    tests: Mapping[str, Any],
    agents: Agents,
    config: TrainConfig,
    folder: Path,
    devices: str,
    on_progress: OnProgress,
) -> Table:
    """Evaluates agents in all tests of a world.

    Args:
        key: of the episodes.
        world: with the tests.
        tests: by name, their parameters.
        agents: to be evaluated.
        config: of the run.
        folder: for checkpoints.
        devices: "one", "all" or "cluster".
        on_progress: called with (stage, done, total, note).

    Returns:
        A row per test and agent.
    """
    rows: list[dict[str, Any]] = []
    for name, params in tests.items():
        found = evaluate(
            key,
            agents,
            world.env,
            params,
            episodes=config.episodes,
            penalty=config.penalty,
            name=name,
            folder=folder,
            devices=devices,
            on_progress=on_progress,
        )
        here = dataclasses.replace(agents, pmdp=agents.pmdp.replace(params=params))
        times = {
            "seconds_per_100_actions": time_agents(key, here),
            "train_seconds": agents.seconds.get("planning", 0.0),
        }
        rows += [{**row, "env": world.name, **times} for row in found]
    return Table(rows)


def summed_up(agents: Agents, seconds: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what happened while learning, over all agents.

    Args:
        agents: with their history.
        seconds: by part of the run.
    """
    history = agents.history
    return {
        "steps": sum(row["steps"] for row in history[-len(agents) :]),
        "crashes": sum(row["crashes"] for row in history),
        "episodes": sum(row["episodes"] for row in history),
        "inadmissible": sum(row["inadmissible"] for row in history),
        "seconds": dict(seconds),
    }


def facts(
    world: World,
    config: TrainConfig,
    threats: Mapping[str, ThreatConfig],
    process: Process,
) -> dict[str, Any]:
    """Returns what is written of a run at its beginning, to use it or to go on with it.

    Args:
        world: what is learned.
        config: of the run.
        threats: settings by kind of hazard.
        process: how it is made.
    """
    return {
        "world": {
            "name": world.name,
            "env": record.name_of(world.env),
            "settings": world.settings,
            "tests": world.tests,
        },
        "config": config,
        "threats": dict(threats),
        "process": process,
        **record.machine(world.env),
    }
