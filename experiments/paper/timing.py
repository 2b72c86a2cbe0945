"""Seconds per 100 actions, all methods in one process; and how long learning took."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import console, evaluation, mpc, policy_gradient, runs, tasks
from experiments.paper import published
from experiments.paper.fig5 import TASKS
from experiments.paper.published import LEARNED_ON
from experiments.paper.scores import AHEAD, PLANS, RP, read
from experiments.paper.section import EXCEEDED, MISSED, Claim, Section, Table, holds
from rp_jax.baselines import actor_critic
from rp_jax.baselines.cpo import CPOConfig
from rp_jax.baselines.mpc import make_search
from rp_jax.planning.pmdp import PMDP

TITLE = "Computation time"
SEARCHES = {env: searches for env, (_, searches) in TASKS.items()}
TIMED = {  # runs of RP
    "circuit": {RP: "circuit_lost", PLANS: "circuit_plans"},
    "jam": {RP: "jam", AHEAD: "jam_ahead"},
    "point_gather": {RP: "point_gather"},
}
ROUNDS = 3
STEPS = 3_000_000  # that the paper's agents learn in


def run(sources: Any, folder: Path) -> dict[str, Any]:
    """A row per task and method: wall time of each round; a row per task: of learning."""
    rows, learning = [], []
    for env in SEARCHES:
        folders = {method: sources(name) for method, name in TIMED[env].items()}
        own = {method: runs.load(folder) for method, folder in folders.items()}
        learning.append(learned(own[RP], folders[RP]))
        timers = timers_of(env, own)
        with console.progress(f"timing, {env}") as bar:
            for i, (method, timer) in enumerate(timers.items()):
                bar("", i, len(timers), method)
                seconds = [timer()[0] for _ in range(ROUNDS)]
                row = {"env": env, "variant": LEARNED_ON[env], "method": method}
                rows.append({**row, "seconds": seconds})
            bar("", len(timers), len(timers))
    return {"actions": rows, "learning": learning}


def learned(run: runs.Run, folder: Path) -> dict[str, Any]:
    """How long reconnaissance and planning of a run took.

    `whole` if that is all of it: with the recipe's labels, and not interrupted.
    """
    trained = read(folder / "training.json")
    module = runs.EXPERIMENTS[run.task.name]
    return {
        "env": run.task.name,
        "seeds": run.config.seeds,
        "steps": trained["steps"],
        "whole": run.task.threats == module.make_task(module.full("tuned")).threats
        and not trained.get("resumed", False),
        **trained["seconds"],
    }


def timers_of(env: str, own: dict[str, runs.Run]) -> dict[str, Callable[[], tuple[float, float]]]:
    """By method, what plays 100 actions and says how long they took: (wall, CPU) time.

    The time of a network does not depend on what it has learned, so DQN has RP's weights and CPO
    none of its own. PID-Lagrangian acts as CPO does.

    Args:
        env: the task.
        own: runs of RP, by kind.
    """
    key = tasks.key_of(0, tasks.EVALUATION)
    found: dict[str, Callable[[], tuple[float, float]]] = {}

    def add(method: str, pmdp: PMDP, policy: Any, weights: Any) -> None:
        act = evaluation.acting(pmdp, policy, weights)
        time = evaluation.action_seconds
        found[method] = functools.partial(time, key, pmdp.env, pmdp.params, act)

    for method, loaded in own.items():
        subject = loaded.subject(LEARNED_ON[env], 0)
        add(method, subject.pmdp, evaluation.greedily(subject.network), subject.weights)
    subject = own[RP].subject(LEARNED_ON[env], 0)
    free = subject.pmdp.replace(threats=None, x=jnp.asarray(jnp.inf))
    add("DQN", free, evaluation.greedily(subject.network), subject.weights)
    actor: Any = actor_critic.make_actor(free, CPOConfig().rollout)
    start = jax.vmap(free.env.reset, (0, None))(jax.random.split(key, 1), free.params)
    weights = actor.init(key, free.perceive(start).encoded)
    add("CPO", free, policy_gradient.modes(CPOConfig(), free), weights)
    model: Any = free.env
    avoided = mpc.AVOIDED.get(env, own[RP].config.penalty)
    for steps in SEARCHES[env]:
        search = make_search(model, free.params, steps, avoided)
        found[f"MPC ({steps} steps)"] = functools.partial(mpc.action_seconds, key, search)
    return found


def tell(results: dict[str, Any]) -> Section:
    """Beside the paper's computation times."""
    lines, claims = [], []
    median = {
        (row["env"], row["method"]): float(np.median(row["seconds"])) for row in results["actions"]
    }
    for (env, method), seconds in median.items():
        paper = published.SECONDS.get(env, {}).get(method)
        again = published.RELEASED_SECONDS.get(env, {}).get(method)
        lines.append(
            {
                "task": env,
                "method": method,
                "seconds": f"{seconds:.4f}",
                "paper": "" if paper is None else f"{paper:g}",
                "released code, two cores": "" if again is None else f"{again:g}",
            }
        )
        if paper is not None:
            claims.append(
                Claim(
                    f"Computation time, {env}: {method}, 100 actions",
                    f"{paper:g} s",
                    f"{seconds:.4f} s",
                    EXCEEDED if seconds < paper else MISSED,
                )
            )
    for env, paper_of in published.SECONDS.items():
        if (env, RP) not in median:
            continue
        (method,) = (name for name in paper_of if name.startswith("MPC"))
        ratio = median[env, method] / median[env, RP]
        theirs = paper_of[method] / paper_of[RP]
        claims.append(
            Claim(
                f"Computation time, {env}: RP acts faster than {method}",
                f"{theirs:.0f} times",
                f"{ratio:.1f} times, with a pruned search in compiled code",
                holds(ratio > 1),
            )
        )
    learned = []
    for row in results["learning"]:
        line, more = _learning(row)
        learned.append(line)
        claims += more if row["env"] in published.SECONDS else []
    return Section(
        f"Wall time of 100 decisions one after another, observation and threat included; median of "
        f"{ROUNDS} rounds. On Circuit, {RP} is the run {TIMED['circuit'][RP]} (times do not depend "
        "on what was learned). The paper's machine is not known. The released code, which is not "
        "part of this repository, was timed once.",
        tables=[
            Table("Seconds per 100 actions", lines),
            Table("Learning, wall time", learned),
        ],
        claims=claims,
    )


def _learning(row: dict[str, Any]) -> tuple[dict[str, Any], list[Claim]]:
    """A line of the table, and the claims on how long it takes; those of as much work alone."""
    recon = row["reconnaissance"] / 60
    planning = (row["planning"] + row["planning_compilation"]) / 60
    line = {
        "task": row["env"],
        "seeds": row["seeds"],
        "steps of all": f"{row['steps']:,}",
        "threat functions, minutes": f"{recon:.1f}",
        "planning of all seeds, minutes": f"{planning:.1f}",
    }
    most, hours = published.THREAT_MINUTES, published.TRAINING_HOURS
    as_many = planning / 60 * STEPS / row["steps"]
    claims = [
        Claim(
            f"Appendix G.1, {row['env']}: hours to plan, {STEPS / 1e6:g}M steps",
            f"{hours:g}, on a GPU",
            f"{as_many:.2f} for as many steps of {row['seeds']} seed(s) side by side, on a CPU "
            f"({row['steps']:,} were made)",
            EXCEEDED if as_many < hours else MISSED,
        ),
    ]
    if row["whole"]:
        claims.append(
            Claim(
                f"Section 5.3, {row['env']}: minutes to learn the threat",
                f"{most:g}",
                f"{recon:.1f}",
                EXCEEDED if recon < most else MISSED,
            )
        )
    return line, claims
