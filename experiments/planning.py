"""Masked Q-learning of all seeds side by side, as one program that is called chunk by chunk."""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from experiments import console, tasks, training
from experiments.training import Member, Trained
from rp_jax import devices, storage
from rp_jax.checkpoints import NO_CHECKPOINTS, Checkpoints, chunks_of
from rp_jax.planning import loop
from rp_jax.planning.loop import LoopConfig, LoopState
from rp_jax.planning.pmdp import PMDP


def during(pmdp: PMDP, share: float, config: tasks.Config) -> PMDP:
    """`pmdp` with the penalty of the moment when a share of the run is over (appendix G.2)."""
    begin = config.learning_penalty_from
    if begin is None:
        return pmdp
    return pmdp.replace(penalty=begin + min(1.0, 2 * share) * (pmdp.penalty - begin))


class Programs(NamedTuple):
    """Compiled, for all members side by side."""

    begin: Callable[..., LoopState]  # (keys, pmdp): as `loop.begin`
    chunk: Callable[..., tuple[LoopState, loop.Metrics]]  # (state, pmdp, iterations, updates)


def compiled(
    keys: jax.Array, pmdp: PMDP, axes: PMDP, planning: LoopConfig, mesh: Mesh | None
) -> Programs:
    """Two programs; the second, which takes longest, fills the replay and learns.

    Args:
        keys: (members,).
        pmdp: of all members.
        axes: its `in_axes`.
        planning: the learner.
        mesh: devices that share the members out; None for one.
    """

    def first(key: jax.Array, pmdp: PMDP) -> LoopState:
        return loop.begin(key, pmdp, planning)

    def onward(state: LoopState, pmdp: PMDP, iterations: jax.Array, updates: jax.Array):
        return loop.chunk(state, pmdp, planning, iterations, updates)

    begin = jax.jit(devices.spread(first, (0, axes), mesh))
    chunk = jax.jit(devices.spread(onward, (0, axes, None, None), mesh), donate_argnums=0)
    shapes = devices.placed(jax.eval_shape(begin, keys, pmdp), mesh)
    return Programs(
        begin=begin.lower(keys, pmdp).compile(),
        chunk=chunk.lower(shapes, pmdp, planning.iterations, planning.updates).compile(),
    )


def plan(
    config: tasks.Config,
    pmdp: PMDP,
    members: Sequence[Member],
    folder: Path,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
) -> Trained:
    """Trains all members as one program; writes metrics.jsonl as it goes, then the agent.

    Args:
        config: the task's settings.
        pmdp: what they learn in, but for their own thresholds and penalties.
        members: who learns.
        folder: for metrics.jsonl and the agent.
        checkpoints: of the learning.

    Raises:
        FloatingPointError: something that was seen or learned is not a finite number.
    """
    planning, mesh = config.planning, devices.mesh_of(config.devices)
    iterations = max(1, planning.iterations - planning.filling)
    chunks, length = chunks_of(iterations, training.CHUNKS)
    names = [tasks.method_name(config, member) for member in members]
    announce(names, (planning.filling + chunks * length) * planning.num_envs, planning)
    pmdp, axes = tasks.side_by_side(pmdp, members)
    keys = tasks.keys_of(members, tasks.PLANNING)
    keys, pmdp = devices.place((keys, pmdp), (0, axes), mesh)

    with console.progress("planning") as bar:
        bar("", 0, chunks, "compiling")
        began = time.perf_counter()
        programs = compiled(keys, pmdp, axes, planning, mesh)
        compile_seconds = time.perf_counter() - began

        def step(i: int, state: LoopState) -> tuple[LoopState, dict[str, Any]]:
            now = during(pmdp, i / chunks, config)
            here = devices.returned(state, mesh)
            state, metrics = programs.chunk(here, now, length, planning.updates)
            return state, devices.gather(metrics, mesh)._asdict()

        def check(params: Any, metrics: dict[str, Any]) -> None:
            loop.check(devices.gather(params, mesh), loop.Metrics(**metrics))

        def more(sums: Mapping[str, float]) -> dict[str, Any]:
            return {
                "insecure": sums["insecure"] / sums["steps"],
                "inadmissible": int(sums["inadmissible"]),
                "loss": sums["loss"] / (length * planning.updates),
            }

        state, filled = programs.chunk(
            programs.begin(keys, pmdp), during(pmdp, 0.0, config), planning.filling, 0
        )
        params, rows, seconds = training.learn(
            training.Learners(members, names, config.penalty, folder, more),
            state,
            counted(devices.gather(filled, mesh), chunks),
            step,
            check,
            lambda state: state.learner.params,
            bar,
            checkpoints if devices.one_process() else NO_CHECKPOINTS,
        )
        params = devices.gather(params, mesh)
    about = {"methods": methods_of(names), "members": [member._asdict() for member in members]}
    storage.save(folder / "agent", "Q-network", params, about)
    return Trained(params, rows, seconds, compile_seconds)


def methods_of(names: Sequence[str]) -> list[str]:
    """Each once."""
    return list(dict.fromkeys(names))


def announce(names: Sequence[str], steps: int, planning: LoopConfig) -> None:
    """What is about to be learned."""
    console.say(
        f"planning: {len(names)} x {steps:,} steps, {planning.samples_per_step:g} samples "
        f"replayed per step, {'; '.join(methods_of(names))}"
    )


def counted(filled: loop.Metrics, chunks: int) -> dict[str, np.ndarray]:
    """(chunks, members) by name: what filled the replay belongs to the first chunk."""
    metrics = {}
    for name, part in filled._asdict().items():
        metrics[name] = np.zeros((chunks, *part.shape), part.dtype)
        metrics[name][0] = part
    return metrics
