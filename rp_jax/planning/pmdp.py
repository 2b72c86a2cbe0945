"""The P-MDP as a learner meets it: an environment, threats, a threshold, and what is seen."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax import shield
from rp_jax.envs.base import Env, renew
from rp_jax.kinematics import Plans
from rp_jax.threat.model import ThreatModel
from rp_jax.threat.static import bounded, plan_clearance, static_threat
from rp_jax.threat.total import total_threat

OUTCOMES = 0x100C  # seed of the outcomes looked at; no environment's keys come from it


class Encoded(NamedTuple):
    """An observation as it is stored: the LIDAR in bytes, the rest as it is."""

    scan: Array  # (..., L) uint8; 255 where nothing is seen
    rest: Array  # (..., R) float


class Percept(NamedTuple):
    """All that a policy may know of a batch of states."""

    encoded: Encoded
    admissible: Array  # (B, A) bool
    secure: Array  # (B,) bool
    threat: Array  # (B, A)


def faults(encoded: Encoded, threat: Array) -> tuple[Array, Array]:
    """(B,) bool each: an observation (B, ...), or the threats (B, A), hold a number that is none.

    What is not floating point cannot.
    """
    seen = [leaf for leaf in jax.tree.leaves(encoded) if leaf.dtype.kind == "f"]
    bad = [not_finite(leaf.reshape(len(leaf), -1)) for leaf in seen]
    return jnp.any(jnp.stack(bad), axis=0), not_finite(threat)


def not_finite(values: Array) -> Array:
    """(B, n) -> (B,) bool."""
    return ~jnp.all(jnp.isfinite(values), axis=-1)


class PMDP(struct.PyTreeNode):
    """Equation 10: the original MDP, restricted to the admissible actions.

    A penalised MDP without a shield is the same with x = infinity and a penalty; with None for
    threats, none is computed.
    """

    params: Any  # of the environment
    threats: dict[str, ThreatModel] | None  # by kind of hazard; None: nothing is ever forbidden
    x: Array  # () threshold of admissible threat
    penalty: Array  # () taken off the reward per unit of danger while learning
    toll: Array  # () likewise, per state reached in which no action is admissible
    env: Env = struct.field(pytree_node=False)
    pool: int = struct.field(pytree_node=False, default=8)  # LIDAR bins seen as one
    lookahead: int = struct.field(pytree_node=False, default=0)  # outcomes of each action that are
    # looked at where no action is admissible by the threats of this state alone

    def perceive(self, states: Any, alive: Array | None = None) -> Percept:
        """Observes a batch of states and finds what is admissible in them.

        Where `alive` (B,) is false, no threat is computed.
        """
        observation = jax.vmap(self.env.observe, (0, None))(states, self.params)
        encoded = jax.vmap(encode, (0, None, None))(observation, self.env.LIDAR_BINS, self.pool)
        threat = self.threat(states, alive)
        mask, secure = jax.vmap(shield.shield, (0, None))(threat, self.x)
        return Percept(encoded, mask, secure, threat)

    def threat(self, states: Any, alive: Array | None = None) -> Array:
        """(B, A) total threat of a batch of states, 0 where not `alive`.

        With `lookahead`, where no action is admissible by the sum over hazards, the lesser of it
        and of its Bellman backup, an upper function as well (docs/theory.md).
        """
        if self.threats is None:
            shape = (states.time.shape[0], self.env.num_actions(self.params))
            return jnp.zeros(shape, self.x.dtype)
        summed = self._summed(states, self._static(states.agent), alive)
        if self.lookahead == 0:
            return summed

        def closer(rows: Array) -> Array:
            chosen = jax.tree.map(lambda a: a.at[rows].get(mode="clip"), states)
            return jnp.minimum(summed.at[rows].get(mode="clip"), self._backup(chosen))

        insecure = jnp.min(summed, axis=-1) > self._threshold(states)
        return renew(insecure, summed, closer, chunk=4)

    def _threshold(self, states: Any) -> Array:
        """() or (B,) what `threat` is compared with."""
        return self.x

    def _static(self, agents: Any) -> Array | None:
        """(B, K, A) joint threat of the fixed hazards, by plan; None without plans."""
        model = self.params.agent
        if not isinstance(model.baseline, Plans):
            return None
        clearance = lambda position: self.env.clearance(position, self.params)  # noqa: E731
        return static_threat(
            jax.vmap(lambda agent: plan_clearance(agent, model, clearance))(agents)
        )

    def _summed(self, states: Any, static: Array | None, alive: Array | None) -> Array:
        """(B, A) sum over hazards (Theorem 3), to which `static` of the states' agents belongs.

        Under several plans, that of the best plan for each action: the least of upper functions
        (docs/theory.md).
        """
        hazards = jax.vmap(self.env.hazards, (0, None))(states, self.params)
        if alive is not None:
            hazards = {
                kind: group._replace(present=group.present & alive[:, None])
                for kind, group in hazards.items()
            }
        if static is None:
            return total_threat(self.threats or {}, states.agent, hazards)
        if hazards:
            moving = bounded(total_threat(self.threats or {}, states.agent, hazards))
            static = static + moving.reshape(static.shape)
        best = jnp.min(static, axis=1)
        return best if alive is None else jnp.where(alive[:, None], best, 0.0)

    def _backup(self, states: Any) -> Array:
        """(B, A) E[d + min_a' U(s', a')], U the sum over hazards, over `lookahead` outcomes.

        The outcomes are drawn jointly, by the environment's own step. Danger is not discounted.
        """
        actions = jnp.arange(self.env.num_actions(self.params))

        def outcomes(state: Any) -> Any:
            key = jax.random.fold_in(jax.random.key(OUTCOMES), state.time)
            keys = jax.random.split(key, self.lookahead)
            step = lambda action, key: self.env.step(key, state, action, self.params)  # noqa: E731
            return jax.vmap(jax.vmap(step, (None, 0)), (0, None))(actions, keys)

        reached, outcome = jax.vmap(outcomes)(states)  # (B, A, S)
        flat = lambda a: a.reshape(-1, *a.shape[3:])  # noqa: E731
        # The agent's own step is no matter of chance (Assumption 1): one of it for each action.
        agents = jax.tree.map(lambda a: a[:, :, 0].reshape(-1, *a.shape[3:]), reached.agent)
        static = self._static(agents)
        if static is not None:
            static = jnp.repeat(static, self.lookahead, axis=0)
        going = flat(~outcome.terminated)
        after = jnp.min(self._summed(jax.tree.map(flat, reached), static, going), axis=-1)
        danger = flat(outcome.danger) + jnp.where(going, after, 0.0)
        return jnp.mean(danger.reshape(outcome.danger.shape), axis=-1)


def encode(observation: Array, scan: int, pool: int) -> Encoded:
    """Splits an observation into its LIDAR, min-pooled and in bytes, and the rest.

    Bytes know no nan: where the LIDAR holds a number that is none, the rest is nan.

    Args:
        observation: (n,) whose first `scan` values are distances in [0, 1], 0 for none.
        scan: number of LIDAR values.
        pool: neighbouring bins of which only the nearest distance is kept.
    """
    distance = jnp.where(observation[:scan] == 0, 1.0, observation[:scan])
    nearest = jnp.min(distance.reshape(scan // pool, pool), axis=-1)
    sound = jnp.all(jnp.isfinite(observation[:scan]))
    rest = jnp.where(sound, observation[scan:], jnp.nan)
    return Encoded(jnp.round(nearest * 255).astype(jnp.uint8), rest)
