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
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

from experiments import (
    cli,
    console,
    evaluation,
    mpc,
    pipeline,
    policy_gradient,
    reconnaissance,
    tables,
    tasks,
    training,
)
from experiments.runs import EXPERIMENTS
from experiments.settings import begin
from rp_jax import storage
from rp_jax.baselines.cpo import CPOConfig
from rp_jax.baselines.pid_lagrangian import PIDConfig
from rp_jax.checkpoints import Checkpoints
from rp_jax.validate import number, one_of

# Penalties of DQN, c, and steps that MPC looks ahead; section 5 and appendix G.
SETTINGS: dict[str, tuple[tuple[float, ...], float, int]] = {
    "circuit": ((0.0, 20.0, 200.0), 1e-3, 4),
    "jam": ((5.0, 50.0, 500.0), 1e-2, 3),
    "point_gather": ((1.0, 10.0, 50.0), 0.1, 2),
}
FIRST_PENALTY = {"jam": 5.0}  # from which that of DQN rises, appendix G.2
METHODS = ("RP", "DQN", "CPO", "PID", "MPC")


@dataclass(frozen=True)
class Config:
    """What is compared."""

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


def settings_of(config: Config) -> Any:
    """The task's own settings, with the comparison's sizes.

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
        threat=config.threat,
        figures=False,
        planning=dataclasses.replace(quick.planning, steps=config.steps),
    )
    settings.validate()
    return settings


def by_q_learning(
    task: tasks.Task,
    config: Any,
    models: dict | None,
    members: Sequence[training.Member],
    folder: Path,
    checkpoints: Checkpoints,
) -> list[dict[str, Any]]:
    """Rows of RP or of penalised DQN; all members learn in one program."""
    pmdp = tasks.make_pmdp(task, config, models, task.train)
    trained, rows = pipeline.plan_and_evaluate(task, config, pmdp, members, folder, checkpoints)
    return with_learning(rows, trained, members)


def by_policy_gradient(
    method: policy_gradient.Method,
    task: tasks.Task,
    config: Any,
    folder: Path,
    checkpoints: Checkpoints,
) -> list[dict[str, Any]]:
    """Rows of CPO or PID-Lagrangian PPO."""
    pmdp = tasks.make_pmdp(task, config, None, task.train)
    agents = policy_gradient.learn(method, pmdp, config, folder, checkpoints.at("planning"))
    rows = evaluation.evaluate_all(task, config, pmdp, agents, checkpoints.at("evaluation"))
    return with_learning(rows, agents.trained, agents.members)


def with_learning(
    rows: Sequence[Mapping[str, Any]],
    trained: training.Trained,
    members: Sequence[training.Member],
) -> list[dict[str, Any]]:
    """Rows of evaluation with what their learners met while learning, and how many they were."""
    found = []
    for row in rows:
        who = (row["method"], row["seed"])
        mine = [h for h in trained.history if (h["method"], h["seed"]) == who]
        met = {
            "training_steps": mine[-1]["steps"],
            "training_episodes": sum(h["episodes"] for h in mine),
            "training_crashes": sum(h["crashes"] for h in mine),
            "side_by_side": len(members),
        }
        found.append({**row, **met})
    return found


def by_search(config: Config, horizon: int, checkpoints: Checkpoints) -> list[dict[str, Any]]:
    """Rows of MPC."""
    settings = mpc.Config(config.env, horizon, config.mpc_episodes, seed=config.seed)
    rows = mpc.run(settings, *mpc.prepare(settings), checkpoints)
    counts = ("training_steps", "training_episodes", "training_crashes", "side_by_side")
    return [{**row, **dict.fromkeys(counts, 0)} for row in rows]


def run(
    config: Config, settings: Any, task: tasks.Task, folder: Path, checkpoints: Checkpoints
) -> list[dict[str, Any]]:
    """Writes compare.json after each method, so that nothing is lost."""
    penalties, limit, horizon = SETTINGS[config.env]
    rows: list[dict[str, Any]] = []

    def add(more: Sequence[dict[str, Any]]) -> None:
        rows.extend(more)
        storage.write_json(folder / "compare.json", rows)

    if "RP" in config.methods:
        models, _, _ = reconnaissance.learn_threats(task, settings, folder, checkpoints)
        members = tasks.members_of(settings)
        at = checkpoints.at("rp")
        add(by_q_learning(task, settings, models, members, folder / "rp", at))
    if "DQN" in config.methods:
        plain = dataclasses.replace(
            settings, x=float("inf"), learning_penalty_from=FIRST_PENALTY.get(config.env)
        )
        each = tasks.members_of(plain)
        members = [m._replace(learning_penalty=p) for p in penalties for m in each]
        at = checkpoints.at("dqn")
        add(by_q_learning(task, plain, None, members, folder / "dqn", at))
    # As released, CPO learns from rewards less the penalty; PID-Lagrangian finds its own.
    on_policy = {
        "CPO": ("CPO", config.cpo, settings.penalty),
        "PID": ("PID-Lagrangian", config.pid, 0.0),
    }
    for method, (name, learning, penalty) in on_policy.items():
        if method in config.methods:
            out, at = folder / method.lower(), checkpoints.at(method.lower())
            learner = policy_gradient.Method(name, learning, limit)
            own = dataclasses.replace(settings, learning_penalty=penalty)
            add(by_policy_gradient(learner, task, own, out, at))
    if "MPC" in config.methods:
        add(by_search(config, horizon, checkpoints.at("mpc")))
    return rows


def show(rows: Sequence[dict[str, Any]]) -> None:
    """One table per variant, a line per method and seed."""
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
                    "% [95 %]": tables.percent(row),
                    "steps": f"{row['training_steps']:,}" if row["training_steps"] else "-",
                    "crashes while learning": learned if row["training_steps"] else "-",
                    "learning, s": took if row["training_steps"] else "-",
                    "ms an action": f"{10 * row['seconds_per_100_actions']:.2f}",
                }
            )
        console.table(f"{rows[0]['env']} {variant}", lines, list(lines[0]))


def main() -> None:
    """Exits with 2 on bad input."""
    name, argv = "experiments.compare", sys.argv[1:]
    folder = cli.to_resume(argv)
    with cli.bad_input():
        if folder is not None:
            config, checkpoints = cli.resumed(name, folder, Config, argv)
            settings = settings_of(config)
            task = pipeline.checked(EXPERIMENTS[config.env].make_task, settings)
        else:
            about = f"{__doc__}\n\n--resume DIR, alone, goes on with an interrupted run."
            config = tyro.cli(Config, prog=f"python -m {name}", description=about)
            settings = dataclasses.replace(
                settings_of(config), out=config.out or pipeline.default_out("compare", config.env)
            )
            make_task = EXPERIMENTS[config.env].make_task
            task, folder = pipeline.prepare(make_task, settings, "compare")
            checkpoints = begin(folder, name, dataclasses.asdict(config))
    with cli.resumable(name, folder, checkpoints):
        show(run(config, settings, task, folder, checkpoints))
        console.say(f"results: {folder}")


if __name__ == "__main__":
    main()
