"""Seconds per 100 actions, all methods in one process; and how long learning took."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import console, mpc, pipeline, runs
from experiments.paper import published
from experiments.paper.scores import read
from experiments.paper.section import EXCEEDED, MISSED, Claim, Section, Table, holds
from rp_jax.baselines import actor_critic, cpo
from rp_jax.baselines.mpc import Search, make_search

TITLE = "Computation time"
SEARCHES = {"circuit": (3, 4), "jam": (2, 3)}
VARIANTS = {"jam": "N=8"}  # elsewhere the first
ROUNDS = 3


def run(sources: Any, folder: Path) -> dict[str, Any]:
    """A row per task and method: wall time of each round; a row per task: of learning."""
    rows, learning = [], []
    for env, searches in SEARCHES.items():
        loaded = runs.load(sources(env))
        trained = read(sources(env) / "training.json")
        row = {"env": env, "seeds": loaded.config.seeds, "steps": trained["steps"]}
        learning.append(row | trained["seconds"])
        subject = loaded.subject(VARIANTS.get(env, ""), 0)
        timers = timers_of(loaded, subject, searches)
        with console.progress(f"timing, {env}") as bar:
            for i, (method, timer) in enumerate(timers.items()):
                bar("", i, len(timers), method)
                seconds = [timer() for _ in range(ROUNDS)]
                row = {"env": env, "variant": subject.variant, "method": method}
                rows.append({**row, "seconds": seconds})
            bar("", len(timers), len(timers))
    return {"actions": rows, "learning": learning}


def timers_of(
    loaded: runs.Run, subject: runs.Subject, searches: tuple[int, ...]
) -> dict[str, Callable[[], float]]:
    """By method, what plays 100 actions and says how long they took.

    The time of a network does not depend on what it has learned, so DQN has RP's weights and CPO
    none of its own. PID-Lagrangian acts as CPO does.
    """
    pmdp, network, weights = subject.pmdp, subject.network, subject.weights
    free = pmdp.replace(threats=None, x=jnp.asarray(jnp.inf))
    key = pipeline.key_of(0, pipeline.EVALUATION)
    penalty = loaded.config.penalty
    found: dict[str, Callable[[], float]] = {
        "RP": lambda: pipeline.action_seconds(pmdp, network, weights),
        "DQN": lambda: pipeline.action_seconds(free, network, weights),
        "CPO": lambda: _gaussian_seconds(free),
    }
    for steps in searches:
        search = make_search(pmdp.env, pmdp.params, steps, penalty)  # type: ignore[arg-type]
        found[f"MPC ({steps} steps)"] = functools.partial(_search_seconds, key, search)
    return found


def _search_seconds(key: jax.Array, search: Search) -> float:
    """Of MPC."""
    return mpc.action_seconds(key, search)[0]


def _gaussian_seconds(pmdp: Any) -> float:
    """Of CPO's policy."""
    actor: Any = actor_critic.make_actor(pmdp, cpo.CPOConfig().rollout)
    start = jax.vmap(pmdp.env.reset, (0, None))(jax.random.split(jax.random.key(0), 1), pmdp.params)
    weights = actor.init(jax.random.key(0), pmdp.perceive(start).encoded)
    act = jax.jit(lambda weights, states, p: actor.apply(weights, p.perceive(states).encoded).mode)
    return pipeline.seconds_of_100(lambda: act(weights, start, pmdp))


def tell(results: dict[str, Any]) -> Section:
    """Beside the paper's computation times."""
    lines, claims = [], []
    median = {
        (row["env"], row["method"]): float(np.median(row["seconds"])) for row in results["actions"]
    }
    for (env, method), seconds in median.items():
        paper = published.SECONDS[env].get(method)
        again = published.RELEASED_SECONDS[env].get(method)
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
    for env, searches in SEARCHES.items():
        method = f"MPC ({searches[-1]} steps)"
        ratio = median[env, method] / median[env, "RP"]
        theirs = published.SECONDS[env][method] / published.SECONDS[env]["RP"]
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
        claims += more
    return Section(
        f"Wall time of 100 decisions one after another, observation and threat included; median of "
        f"{ROUNDS} rounds. The paper's machine is not known.",
        tables=[Table("Seconds per 100 actions", lines), Table("Learning, wall time", learned)],
        claims=claims,
    )


def _learning(row: dict[str, Any]) -> tuple[dict[str, Any], list[Claim]]:
    """A line of the table, and the claims on how long it takes."""
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
    claims = [
        Claim(
            f"Section 5.3, {row['env']}: minutes to learn the threat",
            f"{most:g}",
            f"{recon:.1f}",
            EXCEEDED if recon < most else MISSED,
        ),
        Claim(
            f"Appendix G.1, {row['env']}: hours to plan",
            f"{hours:g}, one seed, 3M steps, a GPU",
            f"{planning / 60:.2f}, {row['seeds']} seed(s), {row['steps']:,} steps in all, a CPU",
            EXCEEDED if planning / 60 < hours else MISSED,
        ),
    ]
    return line, claims
