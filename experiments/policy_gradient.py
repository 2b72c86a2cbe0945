"""CPO and PID-Lagrangian PPO on a task: learning, with its curves, and evaluation."""

import functools
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np

from experiments import console, pipeline, training
from rp_jax import evaluate
from rp_jax.baselines import actor_critic, cpo, pid_lagrangian
from rp_jax.checkpoints import Checkpoints
from rp_jax.validate import finite

LEARNERS: Mapping[str, Any] = {"CPO": cpo, "PID-Lagrangian": pid_lagrangian}


def learn(
    name: str,
    learning: Any,
    limit: float,
    task: pipeline.Task,
    config: Any,
    folder: Path,
    checkpoints: Checkpoints,
) -> training.Trained:
    """Trains all seeds as one program; writes metrics.jsonl as it goes.

    Args:
        name: of the method, in `LEARNERS`.
        learning: its configuration.
        limit: c.
        task: what is learned.
        config: the task's settings.
        folder: for metrics.jsonl, created if missing.
        checkpoints: of the learning.

    Raises:
        FloatingPointError: something that was learned is not a finite number.
    """
    learner, members = LEARNERS[name], pipeline.members_of(config)
    pmdp = pipeline.make_pmdp(task, config, None, task.train)
    chunks, length = training.chunks_of(-(-config.planning.steps // learning.rollout.steps))
    folder.mkdir(exist_ok=True)

    def chunk(state: Any, pmdp: Any, c: jax.Array) -> tuple[Any, actor_critic.Metrics]:
        def one(state: Any, _: None) -> tuple[Any, actor_critic.Metrics]:
            state, metrics = learner.step(state, pmdp, c, learning)
            return state, metrics.rollout

        state, metrics = jax.lax.scan(one, state, None, length=length)
        return state, jax.tree.map(lambda m: jnp.sum(m, axis=0), metrics)

    with console.progress(name) as bar:
        bar("", 0, chunks, "compiling")
        began = time.perf_counter()
        init = jax.jit(jax.vmap(functools.partial(learner.init, config=learning), (0, None)))
        state, c = init(pipeline.keys_of(members, pipeline.PLANNING), pmdp), jnp.float32(limit)
        jitted = jax.jit(
            jax.vmap(chunk, (0, None, None)),
            donate_argnums=0,
            compiler_options=cpo.compiler_options(),
        )
        improve = jitted.lower(state, pmdp, c).compile()
        compiled = time.perf_counter()

        def check(params: Any, _: Any) -> None:
            finite(f"{name}: weights", jax.flatten_util.ravel_pytree(params)[0])

        shapes = jax.eval_shape(jitted, state, pmdp, c)[1]
        params, rows, seconds = training.learn(
            training.Learners(members, [name] * len(members), config.penalty, folder),
            state,
            jax.tree.map(lambda s: np.zeros((chunks, *s.shape), s.dtype), shapes),
            lambda i, state: improve(state, pmdp, c),
            check,
            weights,
            bar,
            checkpoints,
        )
    return training.Trained(params, rows, seconds, compiled - began)


def weights(state: Any) -> Any:
    """Those of the policy, in the state of either learner."""
    return state.actor if isinstance(state, actor_critic.State) else state.learner.actor


def evaluate_all(
    name: str,
    learning: Any,
    trained: training.Trained,
    task: pipeline.Task,
    config: Any,
) -> list[dict[str, Any]]:
    """One row per variant and seed, of the policies' modes.

    Args:
        name: of the method.
        learning: its configuration.
        trained: by `learn`.
        task: what was learned.
        config: the task's settings.
    """
    members = pipeline.members_of(config)
    pmdp = pipeline.make_pmdp(task, config, None, task.train)
    network: Any = actor_critic.make_actor(pmdp, learning.rollout)
    batch = min(1000, config.episodes)

    def one(key: jax.Array, weights: Any, pmdp: Any) -> evaluate.Episodes:
        policy = actor_critic.driver(network, weights, greedy=True)
        return evaluate.play_episodes(key, pmdp, policy, config.episodes, batch=batch)

    everyone = jax.jit(jax.vmap(one, (0, 0, None)))
    act = jax.jit(
        lambda states, weights, pmdp: network.apply(weights, pmdp.perceive(states).encoded).mode
    )
    keys = pipeline.keys_of(members, pipeline.EVALUATION)
    first = jax.tree.map(lambda a: a[0], trained.params)
    rows = []
    with console.progress(f"{name}, evaluation") as bar:
        for done, (variant, params) in enumerate(task.tests.items()):
            bar("", done, len(task.tests), variant)
            this = pmdp.replace(params=params)
            found = jax.tree.map(np.asarray, everyone(keys, trained.params, this))
            evaluate.check(found, f"{name}, {variant}")
            start = jax.vmap(this.env.reset, (0, None))(keys[:1], params)
            seconds = pipeline.seconds_of_100(functools.partial(act, start, first, this))
            for i, member in enumerate(members):
                mine = jax.tree.map(lambda a, i=i: a[i], found)
                rows.append(
                    {
                        "env": task.name,
                        "variant": variant,
                        "method": name,
                        "seed": member.seed,
                        **evaluate.summarise(mine, config.penalty),
                        "seconds_per_100_actions": seconds,
                        "train_seconds": trained.seconds,
                    }
                )
            bar("", done + 1, len(task.tests))
    return rows
