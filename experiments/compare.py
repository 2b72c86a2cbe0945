"""All methods on one task, with as many steps to learn in and the same evaluation.

RP, penalised DQN (several penalties in one program), CPO, PID-Lagrangian PPO, and MPC, which
learns nothing. Counts the crashes while learning as well as those after it. What is evaluated acts
without exploring: greedily, CPO and PID-Lagrangian by their modes. Seconds of learning are those of
all runs that learn side by side in one program, whose number stands beside them.

python -m experiments.compare --env jam
python -m experiments.compare --env jam --methods DQN --steps 12000000   # ten times as many
python -m experiments.compare --env jam --methods CPO --cpo.rollout.num-envs 64
"""

import dataclasses
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax

from experiments.paper.published import AVOIDED, FIRST_PENALTY, SETTINGS
from experiments.resumable import Command, main
from experiments.tasks import EXPERIMENTS
from rp_jax import storage
from rp_jax.baselines.cpo import CPOConfig
from rp_jax.baselines.mpc import make_search
from rp_jax.baselines.pid_lagrangian import PIDConfig
from rp_jax.cli import experiment, terminal
from rp_jax.cli.experiment import Run
from rp_jax.runs import policy_gradient, tables, train
from rp_jax.runs.agents import Agents
from rp_jax.runs.plan import plan
from rp_jax.runs.policy_gradient import Policies
from rp_jax.runs.progress import OnProgress
from rp_jax.runs.train import Process, TrainConfig
from rp_jax.runs.tree_search import evaluate_search
from rp_jax.threat.function import ThreatFunction
from rp_jax.validate import number, one_of

METHODS = ("RP", "DQN", "CPO", "PID", "MPC")
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Config:
    """Settings of a comparison."""

    env: str  # circuit, jam or point_gather
    methods: tuple[str, ...] = METHODS  # any of RP, DQN, CPO, PID, MPC
    steps: int = 600_000  # of the environment, to learn in
    seeds: int = 1
    seed: int = 0  # of the first
    episodes: int = 2_000  # evaluated per variant and seed
    mpc_episodes: int = 200  # MPC is slow
    cpo: CPOConfig = field(default_factory=CPOConfig)
    pid: PIDConfig = field(default_factory=PIDConfig)
    threat: Path | None = None  # folder of a threat function to use again
    out: Path | None = None  # folder for results; default: results/compare-ENV-TIME


def settings_of(config: Config) -> TrainConfig:
    """Returns the task's own settings, with the comparison's sizes.

    Raises:
        ValueError: a setting is out of range.
    """
    module = EXPERIMENTS[one_of("env", config.env, EXPERIMENTS)]
    for method in config.methods:
        one_of("methods", method, METHODS)
    if not config.methods:
        raise ValueError("methods is (); it must name at least one")
    number("steps", config.steps, least=1000, integer=True)
    number("mpc_episodes", config.mpc_episodes, least=1, integer=True)
    config.cpo.validate("cpo")
    config.pid.validate("pid")
    quick = module.quick("tuned")
    settings = dataclasses.replace(
        quick,
        seeds=config.seeds,
        seed=config.seed,
        episodes=config.episodes,
        planning=dataclasses.replace(quick.planning, steps=config.steps),
    )
    settings.validate()
    return settings


def prepared(config: Config) -> Run:
    """Returns the comparison, checked, but for its folder.

    Raises:
        ValueError: a setting is out of range, or a file cannot be used.
    """
    settings = settings_of(config)
    world = EXPERIMENTS[config.env].make_world(settings)
    process = Process(out=config.out, threat=config.threat, figures=False)
    threats = experiment.threats_of(settings)
    train.checked(world, settings, threats, process)
    return Run(world, settings, threats, process, Path())


def by_reconnaissance(config: Config, run: Run, folder: Path, bar: OnProgress) -> Rows:
    """Learns and evaluates RP."""
    threat = train.threat_of(
        jax.random.key(0), run.world, run.config, run.threats, run.folder, run.process, bar
    )
    return by_q_learning(run, folder, bar, threat, x=run.config.x)


def by_penalties(config: Config, run: Run, folder: Path, bar: OnProgress) -> Rows:
    """Learns and evaluates DQN without a shield, with each penalty."""
    first = FIRST_PENALTY.get(config.env)
    penalties, _, _ = SETTINGS[config.env]
    rise = {"learning_penalty": penalties, "learning_penalty_from": first}
    return by_q_learning(run, folder, bar, None, **rise)


def by_q_learning(
    run: Run, folder: Path, bar: OnProgress, threat: ThreatFunction | None, **settings: Any
) -> Rows:
    """Learns all agents in one program, and evaluates them."""
    key, config, world = jax.random.key(0), run.config, run.world
    agents = plan(
        key,
        world.env,
        world.params(),
        threat,
        seeds=numbers(config),
        config=config.planning,
        penalty=config.penalty,
        folder=folder,
        settings=world.settings,
        on_progress=bar,
        **settings,
    )
    tests = {name: world.params(name) for name in world.tests}
    table = train.evaluated(key, world, tests, agents, config, folder, "one", bar)
    return with_learning(table, agents)


def numbers(config: TrainConfig) -> list[int]:
    """Returns the numbers of the agents that learn side by side."""
    return list(range(config.seed, config.seed + config.seeds))


def by_cpo(config: Config, run: Run, folder: Path, bar: OnProgress) -> Rows:
    """Learns and evaluates CPO, as released: from rewards less the penalty."""
    return by_policy_gradient("CPO", config.cpo, run.config.penalty, config, run, folder, bar)


def by_pid(config: Config, run: Run, folder: Path, bar: OnProgress) -> Rows:
    """Learns and evaluates PID-Lagrangian PPO, which finds its penalty itself."""
    return by_policy_gradient("PID-Lagrangian", config.pid, 0.0, config, run, folder, bar)


def by_policy_gradient(
    method: str,
    learner: CPOConfig | PIDConfig,
    learning_penalty: float,
    config: Config,
    run: Run,
    folder: Path,
    bar: OnProgress,
) -> Rows:
    """Learns all policies in one program, and evaluates them."""
    key, settings, world = jax.random.key(0), run.config, run.world
    policies = policy_gradient.learn_policies(
        key,
        world.env,
        world.params(),
        method,
        c=SETTINGS[config.env][1],
        seeds=numbers(settings),
        config=learner,
        steps=config.steps,
        learning_penalty=learning_penalty,
        penalty=settings.penalty,
        folder=folder,
        on_progress=bar,
    )
    rows: Rows = []
    for name in world.tests:
        params = world.params(name)
        table = policy_gradient.evaluate_policies(
            key,
            policies,
            params,
            episodes=settings.episodes,
            penalty=settings.penalty,
            name=name,
            folder=folder,
            on_progress=bar,
        )
        times = {
            "seconds_per_100_actions": policy_gradient.time_policies(key, policies, params).wall,
            "train_seconds": policies.seconds["planning"],
        }
        rows += [{**row, **times} for row in table]
    return with_learning(rows, policies)


def with_learning(rows: Sequence[Mapping[str, Any]], learned: Agents | Policies) -> Rows:
    """Returns rows of evaluation with what was met while learning, and how many learned."""
    found = []
    for row in rows:
        who = (row["method"], row["seed"])
        mine = [h for h in learned.history if (h["method"], h["seed"]) == who]
        met = {
            "training_steps": mine[-1]["steps"],
            "training_episodes": sum(h["episodes"] for h in mine),
            "training_crashes": sum(h["crashes"] for h in mine),
            "side_by_side": len(learned),
        }
        found.append({**row, **met})
    return found


def by_search(config: Config, run: Run, folder: Path, bar: OnProgress) -> Rows:
    """Evaluates MPC, which learns nothing."""
    world, penalty = run.world, run.config.penalty
    _, _, horizon = SETTINGS[config.env]
    avoided = AVOIDED.get(config.env, penalty)
    table = evaluate_search(
        jax.random.key(config.seed),
        {
            name: make_search(world.env, world.params(name), horizon, avoided)
            for name in world.tests
        },
        episodes=config.mpc_episodes,
        penalty=penalty,
        folder=folder,
        on_progress=bar,
    )
    counts = ("training_steps", "training_episodes", "training_crashes", "side_by_side")
    return [{**row, "seed": config.seed, **dict.fromkeys(counts, 0)} for row in table]


MAKERS: dict[str, Callable[[Config, Run, Path, OnProgress], Rows]] = {
    "RP": by_reconnaissance,
    "DQN": by_penalties,
    "CPO": by_cpo,
    "PID": by_pid,
    "MPC": by_search,
}


def compare(config: Config, run: Run) -> Rows:
    """Makes the rows of each method that has none yet; writes compare.json after each."""
    rows: Rows = []
    for method in METHODS:
        if method in config.methods:
            folder = run.folder / method.lower()
            table = folder / "table.json"
            if not table.exists():
                folder.mkdir(exist_ok=True)
                with terminal.progress(method) as bar:
                    storage.write_json(table, MAKERS[method](config, run, folder, bar))
            rows += json.loads(table.read_text())
            storage.write_json(run.folder / "compare.json", rows)
    return rows


def show(rows: Rows) -> None:
    """Prints one table per variant, a line per method and seed."""
    for variant in dict.fromkeys(row["variant"] for row in rows):
        lines = []
        for row in rows:
            if row["variant"] != variant:
                continue
            learned = f"{row['training_crashes']:,} in {row['training_episodes']:,}"
            took = f"{row['train_seconds']:.1f} for {row['side_by_side']}"
            lines.append(
                {
                    "method": row["method"],
                    "seed": row["seed"],
                    "return": tables.earned(row),
                    "crashes": tables.crashed(row),
                    **tables.rates(row),
                    "steps": f"{row['training_steps']:,}" if row["training_steps"] else "-",
                    "crashes while learning": learned if row["training_steps"] else "-",
                    "learning, s": took if row["training_steps"] else "-",
                    "ms an action": f"{10 * row['seconds_per_100_actions']:.2f}",
                }
            )
        terminal.table(f"{rows[0]['env']} {variant}", lines, list(lines[0]))


def job(config: Config, run: Run, folder: Path) -> None:
    """Compares into a folder, and shows the tables."""
    show(compare(config, run._replace(folder=folder)))


COMMAND = Command(
    name="python -m experiments.compare",
    about=f"{__doc__}\n\n--resume DIR, alone, goes on with an interrupted run.",
    settings=Config,
    prepare=prepared,
    title=lambda config: f"compare-{config.env}",
    job=job,
    keep=lambda run, folder: train.keep_threat(run.world, run.process.threat, folder),
)

if __name__ == "__main__":
    main(COMMAND, sys.argv[1:])
