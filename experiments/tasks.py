"""What an experiment is about: its settings, its task, its keys and its P-MDPs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.training import Member
from rp_jax import devices, shield
from rp_jax.envs.base import BASELINES, FIDELITIES, Env
from rp_jax.planning.loop import LoopConfig
from rp_jax.planning.networks import POOLS
from rp_jax.planning.pmdp import PMDP
from rp_jax.threat.build import ThreatConfig
from rp_jax.validate import number, one_of

# Streams of random numbers, apart.
THREAT, SUMS, PLANNING, EVALUATION, STARTS, MEDIA, CERTIFICATE, RARE, CRASHES = range(9)


@dataclass(frozen=True)
class Config:
    """Settings that all tasks share."""

    seeds: int = 1  # training runs, side by side in one program
    seed: int = 0  # of the first; the others count up
    out: Path | None = None  # folder for results; default: results/ENV-PRESET-TIME
    threat: Path | None = None  # folder of a threat function to use again
    x: float = 0.01  # largest admissible threat; inf switches the shield off
    learning_penalty: float = 0.0  # taken off the reward per unit of danger while learning
    learning_penalty_from: float | None = None  # at first; it gets there by half-way
    learning_toll: float = 0.0  # likewise, per state without an admissible action
    penalty: float = 50.0  # taken off the return per unit of danger in the tables
    episodes: int = 10_000  # evaluated per case
    devices: str = "one"  # "all": seeds side by side on every device; "cluster": of every process
    figures: bool = True  # draw figures and an animation
    planning: LoopConfig = field(default_factory=LoopConfig)  # the learner
    fidelity: str = "released"  # "released" as the published numbers, "paper" as the text
    baseline: str = "paper"  # "paper": at random; "plans": braking and evading, walls jointly
    lookahead: int = 0  # outcomes of each action looked at where none is admissible

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        number("seeds", self.seeds, least=1, most=1000, integer=True)
        number("seed", self.seed, least=0, most=2**31 - 1001, integer=True)
        number("x", self.x, least=0, infinite=True)
        number("learning_penalty", self.learning_penalty, least=0)
        if self.learning_penalty_from is not None:
            number("learning_penalty_from", self.learning_penalty_from, least=0)
        number("learning_toll", self.learning_toll, least=0)
        number("penalty", self.penalty, least=0)
        number("episodes", self.episodes, least=1, integer=True)
        one_of("devices", self.devices, devices.DEVICES)
        one_of("fidelity", self.fidelity, FIDELITIES)
        one_of("baseline", self.baseline, BASELINES)
        number("lookahead", self.lookahead, least=0, most=10_000, integer=True)
        self.planning.validate("planning")


class Task(NamedTuple):
    """What distinguishes one task from another: data, and how to draw it."""

    name: str
    env: Env
    train: Any  # environment parameters
    tests: dict[str, Any]  # by variant, environment parameters
    threats: dict[str, ThreatConfig]  # by kind of hazard
    draw: Callable[[Any], None] | None  # makes the task's own figures from a `Finished`


def key_of(seed: int, stream: int) -> jax.Array:
    """The key of one use of a seed; evaluation never shares one with training."""
    return jax.random.fold_in(jax.random.key(seed), stream)


def keys_of(members: Sequence[Member], stream: int) -> jax.Array:
    """(members,) keys of one use; members of one seed share theirs."""
    return jnp.stack([key_of(member.seed, stream) for member in members])


def members_of(config: Config) -> list[Member]:
    """One for each seed."""
    first, x, penalty = config.seed, config.x, config.learning_penalty
    return [Member(first + i, x, penalty) for i in range(config.seeds)]


def method_name(config: Config, member: Member | None = None) -> str:
    """RP with its threshold, or DQN with its penalty."""
    x, penalty = member[1:] if member else (config.x, config.learning_penalty)
    if np.isinf(x):
        return f"DQN (penalty {penalty:g})"
    name = f"RP (x={x:g})" if config.baseline == "paper" else f"RP, plans (x={x:g})"
    return name if penalty == 0 else f"{name[:-1]}, {penalty:g})"


def make_pmdp(task: Task, config: Config, models: Mapping | None, params: Any) -> PMDP:
    """The P-MDP of one variant of the task."""
    return PMDP(
        params=params,
        threats=None if models is None else dict(models),
        x=jnp.asarray(shield.rounded_down(config.x), float),
        penalty=jnp.asarray(config.learning_penalty, float),
        toll=jnp.asarray(config.learning_toll, float),
        env=task.env,
        pool=POOLS[config.planning.network],
        lookahead=config.lookahead,
    )


def side_by_side(pmdp: PMDP, members: Sequence[Member]) -> tuple[PMDP, PMDP]:
    """The P-MDPs of all members, and the `in_axes` of a vmap over them."""
    x = jnp.asarray(shield.rounded_down([member.x for member in members]), float)
    penalty = jnp.asarray([member.learning_penalty for member in members], float)
    axes = pmdp.replace(params=None, threats=None, x=0, penalty=0, toll=None)
    return pmdp.replace(x=x, penalty=penalty), axes
