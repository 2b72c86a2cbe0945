"""Safe reinforcement learning by reconnaissance and planning, in JAX.

The front door: `reconnoitre` learns how dangerous each action is, `plan` learns to earn reward
while taking admissible actions only, `evaluate` and `certify` say how agents do, `save` and `load`
keep them, and `check_env` finds what is wrong with a world of one's own. Names are imported when
they are first used, so that importing this package costs next to nothing.
"""

import importlib
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

__version__ = version("rp_jax")

if TYPE_CHECKING:
    from rp_jax.envs.check import EnvError, check_env
    from rp_jax.envs.contract import Env, Hazards, Outcome
    from rp_jax.hazards.source import HazardSource, SubRMDP
    from rp_jax.planning.dqn import DQNConfig
    from rp_jax.planning.loop import LoopConfig
    from rp_jax.planning.pmdp import PMDP
    from rp_jax.runs.agents import Agent, Agents
    from rp_jax.runs.certify import Certificate, certify
    from rp_jax.runs.evaluate import evaluate
    from rp_jax.runs.plan import plan
    from rp_jax.runs.reconnoitre import reconnoitre
    from rp_jax.runs.saved import load, save
    from rp_jax.runs.tables import Table
    from rp_jax.threat.build import ThreatConfig
    from rp_jax.threat.fit import FitConfig
    from rp_jax.threat.function import ThreatFunction

_HOMES = {
    "Agent": "rp_jax.runs.agents",
    "Agents": "rp_jax.runs.agents",
    "Certificate": "rp_jax.runs.certify",
    "DQNConfig": "rp_jax.planning.dqn",
    "Env": "rp_jax.envs.contract",
    "EnvError": "rp_jax.envs.check",
    "FitConfig": "rp_jax.threat.fit",
    "HazardSource": "rp_jax.hazards.source",
    "Hazards": "rp_jax.envs.contract",
    "LoopConfig": "rp_jax.planning.loop",
    "Outcome": "rp_jax.envs.contract",
    "PMDP": "rp_jax.planning.pmdp",
    "SubRMDP": "rp_jax.hazards.source",
    "Table": "rp_jax.runs.tables",
    "ThreatConfig": "rp_jax.threat.build",
    "ThreatFunction": "rp_jax.threat.function",
    "certify": "rp_jax.runs.certify",
    "check_env": "rp_jax.envs.check",
    "evaluate": "rp_jax.runs.evaluate",
    "load": "rp_jax.runs.saved",
    "plan": "rp_jax.runs.plan",
    "reconnoitre": "rp_jax.runs.reconnoitre",
    "save": "rp_jax.runs.saved",
}

__all__ = [
    "PMDP",
    "Agent",
    "Agents",
    "Certificate",
    "DQNConfig",
    "Env",
    "EnvError",
    "FitConfig",
    "HazardSource",
    "Hazards",
    "LoopConfig",
    "Outcome",
    "SubRMDP",
    "Table",
    "ThreatConfig",
    "ThreatFunction",
    "certify",
    "check_env",
    "evaluate",
    "load",
    "plan",
    "reconnoitre",
    "save",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'rp_jax' has no attribute {name!r}")
    found = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
