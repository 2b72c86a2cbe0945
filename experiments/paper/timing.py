"""Seconds per 100 actions, all methods in one process; and how long learning took."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.figures import words
from experiments.paper import published
from experiments.paper.published import LEARNED_ON
from experiments.paper.scores import AHEAD, PLANS, RP, SEARCHES, read
from experiments.paper.section import EXCEEDED, MISSED, Claim, Section, Table, holds
from rp_jax import recipes
from rp_jax.baselines import actor_critic
from rp_jax.baselines.cpo import CPOConfig
from rp_jax.baselines.mpc import make_search
from rp_jax.cli import terminal
from rp_jax.cli.choice import Choice, chosen
from rp_jax.planning.pmdp import PMDP
from rp_jax.runs.agents import Agent
from rp_jax.runs.dataclass_json import restored
from rp_jax.runs.evaluate import Timing, acting, greedily, timed
from rp_jax.runs.policy_gradient import by_mode
from rp_jax.runs.tree_search import method_name, time_search
from rp_jax.streams import Stream, key_of
from rp_jax.threat.build import ThreatConfig

TITLE = "Computation time"
TIMED = {  # runs of RP
    "circuit": {RP: "circuit_lost", PLANS: "circuit_plans"},
    "jam": {RP: "jam", AHEAD: "jam_ahead"},
    "point_gather": {RP: "point_gather"},
}
TUNED = {  # recipes of threat functions, by kind of hazard
    "wall": recipes.TUNED_WALL,
    "obstacle": recipes.TUNED_OBSTACLE,
    "bomb": recipes.TUNED_BOMB,
}
ROUNDS = 3
STEPS = 3_000_000  # that the paper's agents learn in


def run(sources: Any, folder: Path) -> dict[str, Any]:
    """A row per task and method: wall time of each round; a row per task: of learning."""
    rows, learning = [], []
    for env in SEARCHES:
        folders = {method: sources(name) for method, name in TIMED[env].items()}
        own = {
            method: chosen(Choice(run=made, variant=LEARNED_ON[env])).agents[0]
            for method, made in folders.items()
        }
        facts = read(folders[RP] / "config.json")
        learning.append(learned(env, facts, read(folders[RP] / "training.json")))
        timers = timers_of(env, own, facts["config"]["penalty"])
        with terminal.progress() as bar:
            for i, (method, timer) in enumerate(timers.items()):
                bar(f"timing, {env}", i, len(timers), method)
                seconds = [timer().wall for _ in range(ROUNDS)]
                row = {"env": env, "variant": LEARNED_ON[env], "method": method}
                rows.append({**row, "seconds": seconds})
            bar(f"timing, {env}", len(timers), len(timers), "")
    return {"actions": rows, "learning": learning}


def learned(env: str, facts: dict[str, Any], trained: dict[str, Any]) -> dict[str, Any]:
    """How long reconnaissance and planning of a run took.

    `whole` if that is all of it: with the recipe's labels, and not interrupted.

    Args:
        env: the task.
        facts: the run's config.json.
        trained: its training.json.
    """
    threats = {
        kind: restored(ThreatConfig, plain, f"config.json: {kind}")
        for kind, plain in facts["threats"].items()
    }
    by_recipe = threats == {kind: TUNED[kind] for kind in threats}
    again = facts["process"]["threat"] is not None
    return {
        "env": env,
        "seeds": facts["config"]["seeds"],
        "steps": trained["steps"],
        "whole": by_recipe and not again and not trained.get("resumed", False),
        **trained["seconds"],
    }


def timers_of(env: str, own: dict[str, Agent], penalty: float) -> dict[str, Callable[[], Timing]]:
    """By method, what plays 100 actions and says how long they took.

    The time of a network does not depend on what it has learned, so DQN has RP's weights and CPO
    none of its own. PID-Lagrangian acts as CPO does.

    Args:
        env: the task.
        own: agents of RP, by kind, in the test that is timed.
        penalty: per unit of danger, in the tables.
    """
    key = jax.random.key(0)
    found: dict[str, Callable[[], Timing]] = {}

    def add(method: str, pmdp: PMDP, policy: Any, weights: Any) -> None:
        act, own = acting(pmdp, policy, weights), key_of(key, Stream.TIMING)
        found[method] = functools.partial(timed, own, pmdp.env, pmdp.params, act)

    for method, agent in own.items():
        add(method, agent.pmdp, greedily(agent.network), agent.weights)
    agent = own[RP]
    free = agent.pmdp.replace(threats={}, shielded=False, x=jnp.asarray(jnp.inf))
    add("DQN", free, greedily(agent.network), agent.weights)
    actor: Any = actor_critic.make_actor(free, CPOConfig().rollout)
    start = jax.vmap(free.env.reset, (0, None))(jax.random.split(key, 1), free.params)
    weights = actor.init(key, free.perceive(start).encoded)
    add("CPO", free, by_mode(CPOConfig(), free), weights)
    model: Any = free.env
    avoided = published.AVOIDED.get(env, penalty)
    for steps in SEARCHES[env]:
        search = make_search(model, free.params, steps, avoided)
        found[method_name(search)] = functools.partial(time_search, key, search)
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
    seeds = words.counted(row["seeds"], "seed")
    as_many = planning / 60 * STEPS / row["steps"]
    claims = [
        Claim(
            f"Appendix G.1, {row['env']}: hours to plan, {STEPS / 1e6:g}M steps",
            f"{hours:g}, on a GPU",
            f"{as_many:.2f} for as many steps of {seeds} side by side, on a CPU "
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
