"""Finished runs, read back from their folders: settings, threat models and agents."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from flax import linen as nn

from experiments import circuit, jam, point_gather, settings, tasks
from rp_jax import storage
from rp_jax.planning import loop
from rp_jax.planning.pmdp import PMDP
from rp_jax.threat import artefact
from rp_jax.validate import number, one_of

EXPERIMENTS: dict[str, Any] = {"circuit": circuit, "jam": jam, "point_gather": point_gather}


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Settings that name an agent of a finished run, a test, and what is drawn in it."""

    run: Path  # folder of a finished run
    variant: str = ""  # the test, such as N=8; default: the first
    agent: int = 0  # which of the run's seeds, counted from 0
    seed: int = 0  # of the episodes

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        number("agent", self.agent, least=0, integer=True)
        number("seed", self.seed, least=0, most=2**31 - 1, integer=True)


class Subject(NamedTuple):
    """An agent and where it is tested."""

    variant: str
    pmdp: PMDP
    network: nn.Module
    weights: Any


class Run(NamedTuple):
    """What a finished run leaves to be used again."""

    task: tasks.Task
    config: Any  # the task's own Config
    models: dict | None  # threat models by kind of hazard; None: no shield
    params: Any  # of the Q-networks, leading axis (seeds,)
    sha256: str  # of the settings, the agents and the threat models

    def pmdp(self, variant: str) -> PMDP:
        """The P-MDP of one of the tests.

        Raises:
            ValueError: there is no such test.
        """
        params = self.task.tests[one_of("variant", variant, self.task.tests)]
        return tasks.make_pmdp(self.task, self.config, self.models, params)

    def subject(self, variant: str, agent: int) -> "Subject":
        """One agent in one of the tests; "" is the first of them.

        Raises:
            ValueError: there is no such test or agent.
        """
        number("agent", agent, least=0, most=self.config.seeds - 1, integer=True)
        variant = variant or next(iter(self.task.tests))
        pmdp = self.pmdp(variant)
        weights = jax.tree.map(lambda a: a[agent], self.params)
        return Subject(variant, pmdp, loop.make_network(self.config.planning, pmdp), weights)


def load(folder: Path) -> Run:
    """Reads a run.

    Raises:
        ValueError: something is missing, damaged, or does not fit together.
    """
    folder = Path(folder)
    path, plain = folder / "config.json", settings.read(folder)
    names = [f"experiments.{name}" for name in EXPERIMENTS]
    one_of(f"{path}: experiment", str(plain.get("experiment")), names)
    module = EXPERIMENTS[one_of(f"{path}: task", str(plain.get("task")), EXPERIMENTS)]
    config = settings.restored(module.Config, plain, str(path))
    config.validate()
    task: tasks.Task = module.make_task(config)
    subs = task.env.sub_rmdps(task.train)
    threats = folder / "threat"
    if config.threat is not None and not threats.is_dir():  # as earlier versions left it
        threats = config.threat
    models: dict | None = {}
    used = [folder / "agent" / "manifest.json"]  # these hold the checksums of the arrays
    if np.isinf(config.x):
        models = None
    elif subs:
        models = artefact.load(threats, task.name, subs)
        used.append(threats / "manifest.json")
    pmdp = tasks.make_pmdp(task, config, models, task.train)
    params = agents(folder / "agent", pmdp, config.planning, config.seeds)
    # Where a folder lies does not matter.
    lasting = {name: value for name, value in plain.items() if name not in ("out", "threat")}
    digest = hashlib.sha256(json.dumps(lasting, sort_keys=True).encode())
    for file in used:
        digest.update(file.read_bytes())
    return Run(task, config, models, params, digest.hexdigest())


def agents(folder: Path, pmdp: PMDP, planning: loop.LoopConfig, count: int) -> Any:
    """Parameters of saved Q-networks, leading axis (count,).

    Raises:
        ValueError: they are missing, damaged, or of another number or shape.
    """
    shapes = jax.eval_shape(
        lambda key: loop.begin(key, pmdp, planning).learner.params, jax.random.key(0)
    )
    like = jax.tree.map(lambda s: jax.ShapeDtypeStruct((count, *s.shape), s.dtype), shapes)
    return storage.load(folder, "Q-network", like)
