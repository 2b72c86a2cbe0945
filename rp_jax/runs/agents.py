"""Learned agents: what acts, and all that it needs to act."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct
from jax import Array

from rp_jax.dynamics import Plans
from rp_jax.envs import optional
from rp_jax.envs.check import check_contract
from rp_jax.envs.contract import Env
from rp_jax.evaluation import action_values, shielded
from rp_jax.planning.budgeted import Budgeted, unwrapped, with_budget
from rp_jax.planning.loop import LoopConfig
from rp_jax.planning.percept import Percept
from rp_jax.planning.pmdp import PMDP
from rp_jax.runs.record import short_name
from rp_jax.shield import threshold_array
from rp_jax.threat.function import ThreatFunction
from rp_jax.validate import number, shown


class Member(NamedTuple):
    """Number, threshold and penalty of one of several agents that learn side by side."""

    seed: int  # its number
    x: float  # threshold of admissible threat
    learning_penalty: float  # taken off the reward per unit of danger while learning


class Agent(struct.PyTreeNode):
    """One learned agent: its action values, and the P-MDP that says what it may do."""

    pmdp: PMDP
    weights: Any  # of the network
    network: nn.Module = struct.field(pytree_node=False)

    def values(self, percept: Percept) -> Array:
        """Returns the action values of a batch of percepts, (B, A).

        Args:
            percept: leading axis (B,), as `look` returns it.
        """
        return action_values(self.network, self.weights)(percept)

    def act(self, states: Any) -> Array:
        """Returns the best admissible action in each state; where there is none, the safest.

        Args:
            states: of the environment, one or with a leading axis (B,).

        Returns:
            () or (B,) int.

        Raises:
            ValueError: they are no states.
        """
        times: Any = getattr(states, "time", None)
        if not hasattr(states, "body") or times is None or jnp.ndim(times) > 1:
            raise ValueError(
                f"states is {shown(states)}; it must be states of the environment, as reset and "
                "step return them, one or with one leading axis"
            )
        return _acted(self, states)

    def __repr__(self) -> str:
        x = self.pmdp.x
        number = str(x) if isinstance(x, jax.core.Tracer) else f"{float(x):.4g}"
        who = f"RP (x={number})" if self.pmdp.shielded else "without a shield"
        return f"Agent({short_name(self.pmdp.env)}: {who})"

    def look(self, states: Any) -> Percept:
        """Returns what is seen in states, the threat of each action, and which are admissible.

        Args:
            states: of the environment, with a leading axis (B,).
        """
        return _looked(self.pmdp, states)


@jax.jit
def _looked(pmdp: PMDP, states: Any) -> Percept:
    return pmdp.perceive(states)


@jax.jit
def _acted(agent: Agent, states: Any) -> Array:
    single = jnp.ndim(states.time) == 0
    batch = jax.tree.map(lambda a: jnp.asarray(a)[None], states) if single else states
    action, _ = shielded(agent.values)(jax.random.key(0), agent.pmdp.perceive(batch))
    return action[0] if single else action


@dataclass(frozen=True)
class Agents(Sequence[Agent]):
    """Agents that learned side by side; `agents[0]` is the first, `agents[1:]` the others."""

    pmdp: PMDP  # what they learned in, but for their own thresholds and penalties
    network: nn.Module
    weights: Any  # leading axis (n,)
    members: tuple[Member, ...]  # (n,)
    config: LoopConfig  # of the learner
    threat: ThreatFunction | None = None  # None: learned without a shield
    history: list[dict[str, Any]] = field(default_factory=list)  # a row per chunk and agent
    seconds: dict[str, float] = field(default_factory=dict)  # of compilation and learning

    def __len__(self) -> int:
        return len(self.members)

    def __repr__(self) -> str:
        which = ", ".join(dict.fromkeys(self.methods))
        return f"Agents({short_name(self.pmdp.env)}: {len(self)} of {which})"

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            members = self.members[index]
            weights = jax.tree.map(lambda a: a[index], self.weights)
            return replace(self, members=members, weights=weights)
        member = self.members[index]
        weights = jax.tree.map(lambda a: a[index], self.weights)
        return Agent(with_member(self.pmdp, member), weights, self.network)

    @property
    def promised(self) -> tuple[float, float] | None:
        """Least and greatest danger of an episode that is promised; None without a budget."""
        if not isinstance(self.pmdp.env, Budgeted):
            return None
        return float(self.pmdp.params.low), float(self.pmdp.params.high)

    def in_world(
        self, env: Env | None = None, params: Any = None, c: float | None = None
    ) -> "Agents":
        """Returns the agents in another world, in theirs with other parameters, or promising c.

        Args:
            env: the world; theirs by default.
            params: its parameters; those that they learned with by default.
            c: the danger that an episode may have, for agents that learned with such a budget;
                what they learned with by default.

        Raises:
            ValueError: they cannot act there: something is seen or done otherwise, or the threats
                hold for another body, baseline policy or hazard; or they know no budget.
        """
        pmdp, promised = self.pmdp, self.promised
        if env is None and params is None and c is None:
            return self
        if c is not None:
            number("c", c, above=0)
            if promised is None:
                raise ValueError(f"c is {c:g}, but these agents learned without; see plan(c=...)")
        there = pmdp.replace(
            env=pmdp.env if env is None else env, params=pmdp.params if params is None else params
        )
        if promised is not None:
            inner, found = unwrapped(there.env, there.params)
            env_there, params_there = with_budget(
                inner, found, *(promised if c is None else (c, c))
            )
            there = there.replace(env=env_there, params=params_there)
        check_contract(there.env, there.params)
        check_same_interface((pmdp.env, pmdp.params), (there.env, there.params))
        if self.threat is not None:
            self.threat.check_fits(there.env.sub_rmdps(there.params))
        return replace(self, pmdp=there)

    @property
    def methods(self) -> list[str]:
        """How each is called in tables, (n,)."""
        return [method_name(self.pmdp, member) for member in self.members]


def check_same_interface(learned: tuple[Env, Any], other: tuple[Env, Any]) -> None:
    """Raises ValueError unless what learned in one world can act in another.

    Args:
        learned: the environment and the parameters of the one.
        other: those of the other.

    Raises:
        ValueError: the observation, its LIDAR, or the number of actions differs.
    """
    kinds = {
        "length of the observation": optional.observation_size,
        "number of LIDAR bins": lambda env, params: optional.lidar_bins(env),
        "number of actions": optional.num_actions,
    }
    for name, of in kinds.items():
        wanted, found = of(*learned), of(*other)
        if found != wanted:
            raise ValueError(f"{name} is {found}; it must be {wanted}, as where the agents learned")


def with_member(pmdp: PMDP, member: Member) -> PMDP:
    """Returns a P-MDP with the threshold and the penalty of one agent.

    Args:
        pmdp: of several.
        member: one of them.
    """
    return pmdp.replace(
        x=threshold_array(member.x),
        penalty=jnp.asarray(member.learning_penalty, float),
    )


def side_by_side(pmdp: PMDP, members: Sequence[Member]) -> tuple[PMDP, PMDP]:
    """Returns the P-MDPs of several agents in one, and the `in_axes` of a vmap over them.

    Args:
        pmdp: with a threshold and a penalty of one agent.
        members: (n,) whose thresholds and penalties replace these.
    """
    x = threshold_array([member.x for member in members])
    penalty = jnp.asarray([member.learning_penalty for member in members], float)
    axes = pmdp.replace(
        params=None, threats=None, x=0, penalty=0, insecure_penalty=None, correction=None
    )
    return pmdp.replace(x=x, penalty=penalty), axes


def method_name(pmdp: PMDP, member: Member) -> str:
    """Returns what an agent is called in tables: RP with its threshold, or DQN with its penalty.

    Args:
        pmdp: what it learned in.
        member: the agent.
    """
    penalty, budget = member.learning_penalty, isinstance(pmdp.env, Budgeted)
    if not pmdp.shielded or (member.x == float("inf") and not budget):
        return f"DQN (penalty {penalty:g})"
    plans = ", plans" if isinstance(pmdp.params.body.baseline, Plans) else ""
    if isinstance(pmdp.env, Budgeted):
        low, high = float(pmdp.params.low), float(pmdp.params.high)
        told = f"c={low:.4g}" if low == high else f"c={low:.4g} to {high:.4g}"
        cap = "" if member.x == float("inf") else f", x={member.x:g}"
        return f"RP{plans} ({told}{cap})"
    extra = "" if penalty == 0 else f", {penalty:g}"
    return f"RP{plans} (x={member.x:g}{extra})"
