"""All methods on one task, with as many steps to learn in and the same evaluation.

RP, penalised DQN (several penalties in one program), CPO, PID-Lagrangian PPO, and MPC, which
learns nothing. Counts the crashes while learning as well as those after it.

python -m experiments.compare --env jam
"""

import dataclasses
import functools
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import tyro

from experiments import cli, console, mpc, pipeline, tables
from experiments.runs import EXPERIMENTS
from experiments.settings import begin
from rp_jax import evaluate, storage
from rp_jax.baselines import actor_critic, cpo, pid_lagrangian
from rp_jax.checkpoints import Checkpoints
from rp_jax.planning.pmdp import PMDP
from rp_jax.validate import finite, number, one_of

# Penalties of DQN, c, and steps that MPC looks ahead; section 5 and appendix G.
SETTINGS: dict[str, tuple[tuple[float, ...], float, int]] = {
    "circuit": ((0.0, 20.0, 200.0), 1e-3, 3),
    "jam": ((5.0, 50.0, 500.0), 1e-2, 3),
    "point_gather": ((1.0, 10.0, 50.0), 0.1, 2),
}
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
    task: pipeline.Task,
    config: Any,
    models: dict | None,
    members: Sequence[pipeline.Member],
    folder: Path,
    checkpoints: Checkpoints,
) -> list[dict[str, Any]]:
    """Rows of RP or of penalised DQN; all members learn in one program."""
    pmdp = pipeline.make_pmdp(task, config, models, task.train)
    trained, rows = pipeline.plan_and_evaluate(task, config, pmdp, members, folder, checkpoints)
    for row in rows:
        name, seed = row["method"], row["seed"]
        mine = [h for h in trained.history if (h["method"], h["seed"]) == (name, seed)]
        row["training_steps"] = mine[-1]["steps"]
        row["training_episodes"] = sum(h["episodes"] for h in mine)
        row["training_danger"] = sum(h["crashes"] for h in mine)
    return rows


def by_policy_gradient(
    name: str,
    learner: Any,
    learning: Any,
    limit: float,
    task: pipeline.Task,
    config: Any,
    checkpoints: Checkpoints,
) -> list[dict[str, Any]]:
    """Rows of CPO or of PID-Lagrangian PPO; all seeds learn in one program.

    Args:
        name: of the method.
        learner: `baselines.cpo` or `baselines.pid_lagrangian`.
        learning: its configuration.
        limit: c.
        task: what is learned.
        config: the task's settings.
        checkpoints: of the learning.
    """
    members = pipeline.members_of(config)
    pmdp = pipeline.make_pmdp(task, config, None, task.train)
    keys = pipeline.keys_of(members, pipeline.PLANNING)
    steps = -(-config.planning.steps // learning.rollout.steps)
    with console.progress(name) as bar:
        bar("", 0, steps, "compiling")
        init = jax.jit(jax.vmap(functools.partial(learner.init, config=learning), (0, None)))
        step = jax.jit(
            jax.vmap(functools.partial(learner.step, config=learning), (0, None, None)),
            donate_argnums=0,
        )
        state, c = init(keys, pmdp), jnp.asarray(limit, jnp.float32)
        improve = step.lower(state, pmdp, c).compile()

        def advance(i: int, carried: tuple[Any, Any]) -> tuple[Any, Any]:
            state, metrics = improve(carried[0], pmdp, c)
            sums = jax.tree.map(np.add, carried[1], jax.tree.map(np.asarray, metrics.rollout))
            finite(f"{name}: weights", jax.flatten_util.ravel_pytree(_actor(learner, state))[0])
            ended = max(1.0, float(sums.episodes.sum()))
            note = f"return {(sums.score - config.penalty * sums.danger).sum() / ended:.1f}"
            bar("", i + 1, steps, note)
            return state, sums

        began = time.perf_counter()
        shapes = jax.eval_shape(step, state, pmdp, c)[1].rollout
        blank = jax.tree.map(lambda s: np.zeros(s.shape, s.dtype), shapes)
        state, sums = checkpoints.loop((state, blank), advance, steps)
        seconds = time.perf_counter() - began
    weights = _actor(learner, state)
    rows = []
    for row in _evaluated(name, weights, learning.rollout, pmdp, members, task, config):
        i = row["seed"] - config.seed
        row["train_seconds"] = seconds
        row["training_steps"] = int(sums.steps[i])
        row["training_episodes"] = int(sums.episodes[i])
        row["training_danger"] = float(sums.danger[i])
        rows.append(row)
    return rows


def _actor(learner: Any, state: Any) -> Any:
    return state.actor if learner is cpo else state.learner.actor


def _evaluated(
    name: str,
    weights: Any,
    rollout: actor_critic.ActorCriticConfig,
    pmdp: PMDP,
    members: Sequence[pipeline.Member],
    task: pipeline.Task,
    config: Any,
) -> list[dict[str, Any]]:
    """One row per variant and seed, of the policies' modes."""
    network: Any = actor_critic.make_actor(pmdp, rollout)
    batch = min(1000, config.episodes)

    def one(key: jax.Array, weights: Any, pmdp: PMDP) -> evaluate.Episodes:
        policy = actor_critic.driver(network, weights, greedy=True)
        return evaluate.play_episodes(key, pmdp, policy, config.episodes, batch=batch)

    everyone = jax.jit(jax.vmap(one, (0, 0, None)))
    act = jax.jit(
        lambda states, weights, pmdp: network.apply(weights, pmdp.perceive(states).encoded).mode
    )
    keys = pipeline.keys_of(members, pipeline.EVALUATION)
    rows = []
    with console.progress(f"{name}, evaluation") as bar:
        for done, (variant, params) in enumerate(task.tests.items()):
            bar("", done, len(task.tests), variant)
            this = pmdp.replace(params=params)
            found = jax.tree.map(np.asarray, everyone(keys, weights, this))
            start = jax.vmap(this.env.reset, (0, None))(keys[:1], params)
            first = jax.tree.map(lambda a: a[0], weights)
            seconds = pipeline.seconds_of_100(functools.partial(act, start, first, this))
            for i, member in enumerate(members):
                rows.append(
                    {
                        "env": task.name,
                        "variant": variant,
                        "method": name,
                        "seed": member.seed,
                        **evaluate.summarise(
                            jax.tree.map(lambda a, i=i: a[i], found), config.penalty
                        ),
                        "seconds_per_100_actions": seconds,
                    }
                )
            bar("", done + 1, len(task.tests))
    return rows


def by_search(config: Config, horizon: int) -> list[dict[str, Any]]:
    """Rows of MPC."""
    settings = mpc.Config(config.env, horizon, config.mpc_episodes, seed=config.seed)
    rows = mpc.run(settings, *mpc.prepare(settings))
    nothing = {"training_steps": 0, "training_episodes": 0, "training_danger": 0}
    return [{**row, **nothing} for row in rows]


def run(
    config: Config, settings: Any, task: pipeline.Task, folder: Path, checkpoints: Checkpoints
) -> list[dict[str, Any]]:
    """Writes compare.json after each method, so that nothing is lost."""
    penalties, limit, horizon = SETTINGS[config.env]
    rows: list[dict[str, Any]] = []

    def add(more: Sequence[dict[str, Any]]) -> None:
        rows.extend(more)
        storage.write_json(folder / "compare.json", rows)

    if "RP" in config.methods:
        models, _, _ = pipeline.learn_threats(task, settings, folder, checkpoints)
        members = pipeline.members_of(settings)
        at = checkpoints.at("rp")
        add(by_q_learning(task, settings, models, members, folder / "rp", at))
    if "DQN" in config.methods:
        plain = dataclasses.replace(settings, x=float("inf"))
        each = pipeline.members_of(plain)
        members = [m._replace(learning_penalty=p) for p in penalties for m in each]
        at = checkpoints.at("dqn")
        add(by_q_learning(task, plain, None, members, folder / "dqn", at))
    if "CPO" in config.methods:
        at = checkpoints.at("cpo")
        add(by_policy_gradient("CPO", cpo, cpo.CPOConfig(), limit, task, settings, at))
    if "PID" in config.methods:
        learner, learning, at = pid_lagrangian, pid_lagrangian.PIDConfig(), checkpoints.at("pid")
        name = "PID-Lagrangian"
        add(by_policy_gradient(name, learner, learning, limit, task, settings, at))
    if "MPC" in config.methods:
        add(by_search(config, horizon))
    return rows


def show(rows: Sequence[dict[str, Any]]) -> None:
    """One table per variant, a line per method and seed."""
    for variant in dict.fromkeys(row["variant"] for row in rows):
        lines = []
        for row in rows:
            if row["variant"] != variant:
                continue
            learned = f"{row['training_danger']:,.0f} in {row['training_episodes']:,}"
            lines.append(
                {
                    "method": row["method"],
                    "seed": row["seed"],
                    "return": f"{row['return_mean']:.2f} +- {row['return_ci95']:.2f}",
                    "crashes": f"{row['crashes']:,} of {row['episodes']:,}",
                    "% [95 %]": tables.percent(row),
                    "crashes while learning": learned if row["training_steps"] else "-",
                    "learning, s": f"{row['train_seconds']:.1f}",
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
