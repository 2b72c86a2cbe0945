"""The P-MDP as a learner meets it: an environment, threats, a threshold, and what is seen."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax import shield
from rp_jax.envs.base import Env
from rp_jax.kinematics import Plans
from rp_jax.threat.model import ThreatModel
from rp_jax.threat.static import bounded, plan_clearance, static_threat
from rp_jax.threat.total import total_threat


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

        Under several plans, that of the best plan for each action: the least of upper functions
        (docs/theory.md).
        """
        if self.threats is None:
            shape = (states.time.shape[0], self.env.num_actions(self.params))
            return jnp.zeros(shape, self.x.dtype)
        hazards = jax.vmap(self.env.hazards, (0, None))(states, self.params)
        if alive is not None:
            hazards = {
                kind: group._replace(present=group.present & alive[:, None])
                for kind, group in hazards.items()
            }
        model = self.params.agent
        if not isinstance(model.baseline, Plans):
            return total_threat(self.threats, states.agent, hazards)
        clear = jax.vmap(
            lambda agent: plan_clearance(
                agent, model, lambda position: self.env.clearance(position, self.params)
            )
        )(states.agent)
        threat = static_threat(clear)  # (B, K, A)
        if hazards:
            moving = bounded(total_threat(self.threats, states.agent, hazards))
            threat = threat + moving.reshape(threat.shape)
        best = jnp.min(threat, axis=1)
        return best if alive is None else jnp.where(alive[:, None], best, 0.0)


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
