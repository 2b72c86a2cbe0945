"""Options that name an agent of a finished run, and the world that it is tested in."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rp_jax import storage
from rp_jax.cli.experiment import world_of
from rp_jax.runs import saved
from rp_jax.runs.agents import Agent, Agents
from rp_jax.runs.record import short_name
from rp_jax.threat import artefact
from rp_jax.validate import number


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Options that name the agents of a run, a test, and what is drawn in it."""

    run: Path  # folder of a finished run, or of agents that were saved
    env: str = ""  # module of the world, such as my_package.world; default: that of the run
    variant: str = ""  # a test of the run, such as N=8; default: its first, if it has any
    set: tuple[str, ...] = ()  # KEY=VALUE, settings of the world other than those of the test
    seed: int = 0  # of the episodes

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        number("seed", self.seed, least=0, most=2**31 - 1, integer=True)


@dataclass(frozen=True, kw_only=True)
class AgentChoice(Choice):
    """Options that name one agent of a run, a test, and what is drawn in it."""

    agent: int = 0  # which of the run's agents, counted from 0

    def validate(self) -> None:
        """Raises ValueError, naming the field, if a value is out of range."""
        super().validate()
        number("agent", self.agent, least=0, integer=True)


class Chosen(NamedTuple):
    """Agents of a run, in a test."""

    agents: Agents  # in the world of the test
    name: str  # of the world
    variant: str  # name of the test
    sha256: str  # of the agents and the threat function

    def agent(self, index: int) -> Agent:
        """Returns one of the agents.

        Args:
            index: counted from 0.

        Raises:
            ValueError: there are not so many.
        """
        number("agent", index, least=0, most=len(self.agents) - 1, integer=True)
        return self.agents[index]

    @property
    def about(self) -> dict[str, Any]:
        """Facts that results of this choice begin with."""
        return {"env": self.name, "variant": self.variant, "sha256": self.sha256}


def parsed_settings(words: Sequence[str]) -> dict[str, Any]:
    """Returns settings from words like num_obstacles=8.

    Args:
        words: KEY=VALUE each; values are read as JSON, or else as text.

    Raises:
        ValueError: a word has no "=".
    """
    found = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not key:
            raise ValueError(f"set is {word!r}; it must be KEY=VALUE")
        try:
            found[key] = json.loads(value)
        except ValueError:
            found[key] = value
    return found


def chosen(choice: Choice) -> Chosen:
    """Loads the agents of a run into the world of a test.

    Args:
        choice: the options.

    Raises:
        ValueError: there is no such run, test or agent, or something does not fit together.
    """
    choice.validate()
    env = saved.imported(choice.env) if choice.env else None
    agents = saved.load(choice.run, env)
    if not isinstance(agents, Agents):
        raise ValueError(f"run is {choice.run}; it must have agents, but holds a threat function")
    if isinstance(choice, AgentChoice):
        number("agent", choice.agent, least=0, most=len(agents) - 1, integer=True)
    variant, name = choice.variant, short_name(agents.pmdp.env)
    if (choice.run / "config.json").exists():
        world = world_of(choice.run, agents.pmdp.env)
        name, variant = world.name, variant or next(iter(world.tests), "")
        if variant:
            world.params(variant)
        settings = world.tests.get(variant, world.settings)
    elif variant:
        raise ValueError(f"variant is {variant!r}; {choice.run} has no tests: use --set")
    else:
        settings = dict(saved.about_agents(choice.run).get("settings") or {})
    changes = parsed_settings(choice.set)
    if variant or changes:
        world_env: Any = agents.pmdp.env
        try:
            params = world_env.make_params(**{**settings, **changes})
        except TypeError as error:
            raise ValueError(f"set is {choice.set}; it must fit make_params ({error})") from error
        agents = agents.in_world(params=params)
    label = " ".join([variant, *choice.set]).strip()
    return Chosen(agents, name, label, identity(choice.run))


def identity(folder: Path) -> str:
    """Returns the checksum of the agents and the threat function in a folder.

    Args:
        folder: of the run.
    """
    digest = hashlib.sha256()
    agents = storage.read_manifest(folder / saved.AGENTS, saved.KIND)
    digest.update(agents["sha256"].encode())
    threat = folder / saved.THREAT
    if (threat / "manifest.json").exists():
        digest.update(storage.read_manifest(threat, artefact.KIND)["sha256"].encode())
    return digest.hexdigest()
