"""CPO and PID-Lagrangian PPO on a task: learning, with its curves, and how they act then."""

import functools
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np

from experiments import console, evaluation, tasks, training
from rp_jax import evaluate, storage
from rp_jax.baselines import actor_critic, cpo, pid_lagrangian
from rp_jax.checkpoints import Checkpoints, chunks_of
from rp_jax.planning.pmdp import PMDP
from rp_jax.validate import finite, none_bad

LEARNERS: Mapping[str, Any] = {"CPO": cpo, "PID-Lagrangian": pid_lagrangian}


class Method(NamedTuple):
    """What learns, and under which constraint."""

    name: str  # in `LEARNERS`
    learning: Any  # configuration of the learner
    limit: float  # c


def learn(
    method: Method, pmdp: PMDP, config: Any, folder: Path, checkpoints: Checkpoints
) -> evaluation.Agents:
    """Trains all seeds as one program; writes metrics.jsonl as it goes, then the actors.

    They act by their modes.

    Args:
        method: what learns.
        pmdp: without threats; its penalty is taken off the rewards.
        config: the task's settings.
        folder: for metrics.jsonl and the actors, created if missing.
        checkpoints: of the learning.

    Raises:
        FloatingPointError: something that was seen or learned is not a finite number.
    """
    name, learning, limit = method
    learner, members = LEARNERS[name], tasks.members_of(config)
    names = [name] * len(members)
    rounds = -(-config.planning.steps // learning.rollout.steps)
    chunks, length = chunks_of(rounds, training.CHUNKS)
    folder.mkdir(exist_ok=True)

    def chunk(state: Any, pmdp: PMDP, c: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        def one(state: Any, _: None) -> tuple[Any, dict[str, jax.Array]]:
            state, metrics = learner.step(state, pmdp, c, learning)
            return state, metrics.rollout._asdict() | updates(metrics)

        state, metrics = jax.lax.scan(one, state, None, length=length)
        return state, jax.tree.map(lambda m: jnp.sum(m, axis=0), metrics)

    def more(sums: Mapping[str, float]) -> dict[str, Any]:
        counted = actor_critic.Metrics._fields
        return {key: value / length for key, value in sums.items() if key not in counted}

    with console.progress(name) as bar:
        bar("", 0, chunks, "compiling")
        began = time.perf_counter()
        init = jax.jit(jax.vmap(functools.partial(learner.init, config=learning), (0, None)))
        state, c = init(tasks.keys_of(members, tasks.PLANNING), pmdp), jnp.float32(limit)
        jitted = jax.jit(
            jax.vmap(chunk, (0, None, None)),
            donate_argnums=0,
            compiler_options=cpo.compiler_options(),
        )
        improve = jitted.lower(state, pmdp, c).compile()
        compiled = time.perf_counter()

        def step(_: int, state: Any) -> tuple[Any, dict[str, jax.Array]]:
            state, metrics = improve(state, pmdp, c)
            counts = {key: metrics[key] for key in actor_critic.Metrics._fields}
            none_bad(name, actor_critic.Metrics(**counts))
            # Not finite, it stops CPO without a word: no step is then accepted.
            critic = carried(state).critic
            finite(f"{name}: values' weights", jax.flatten_util.ravel_pytree(critic)[0])
            return state, metrics

        def check(params: Any, metrics: dict[str, Any]) -> None:
            finite(f"{name}: weights", jax.flatten_util.ravel_pytree(params)[0])
            for key in ("score", "danger"):
                finite(f"{name}: {key}", metrics[key])

        shapes = jax.eval_shape(jitted, state, pmdp, c)[1]
        params, rows, seconds = training.learn(
            training.Learners(members, names, config.penalty, folder, more),
            state,
            {key: np.zeros((chunks, *s.shape), s.dtype) for key, s in shapes.items()},
            step,
            check,
            lambda state: carried(state).actor,
            bar,
            checkpoints,
        )
    about = {"method": name, "limit": limit, "members": [member._asdict() for member in members]}
    storage.save(folder / "agent", "actor", params, about)
    trained = training.Trained(params, rows, seconds, compiled - began)
    return evaluation.Agents(members, names, modes(learning, pmdp), trained)


def carried(state: Any) -> actor_critic.State:
    """Actor and critic, in the state of either learner."""
    return state if isinstance(state, actor_critic.State) else state.learner


def updates(metrics: Any) -> dict[str, jax.Array]:
    """What an update did, as numbers to be averaged; of either learner."""
    if isinstance(metrics, pid_lagrangian.Metrics):
        return {"multiplier": metrics.penalty}
    kl, case, accepted = metrics.update
    return {
        "kl": kl,
        "recoveries": (case == cpo.RECOVERY).astype(kl.dtype),
        "accepted": accepted.astype(kl.dtype),
    }


def modes(learning: Any, pmdp: PMDP) -> Callable[[Any], evaluate.Policy]:
    """The policy of an actor's weights that always takes its mode.

    Args:
        learning: configuration of the learner.
        pmdp: what it has learned in.
    """
    network = actor_critic.make_actor(pmdp, learning.rollout)
    return lambda weights: actor_critic.driver(network, weights, greedy=True)
