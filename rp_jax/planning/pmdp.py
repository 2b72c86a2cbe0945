"""The P-MDP as a learner meets it: an environment, its threats, and a threshold."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax import shield
from rp_jax.arrays import replace_rows
from rp_jax.dynamics import Plans
from rp_jax.envs import optional
from rp_jax.envs.contract import Env, Outcome
from rp_jax.planning.percept import Percept, encode
from rp_jax.threat.model import ThreatModel
from rp_jax.threat.static import compress_above_one, plan_clearances, static_threat
from rp_jax.threat.total import total_threat

OUTCOMES = 0x100C  # seed for sampled outcomes of actions; no environment's keys come from it


class PMDP(struct.PyTreeNode):
    """The planning MDP: the original MDP, restricted to the admissible actions (equation 10).

    An action is admissible if its threat is at most x. A state without such an action is called
    insecure; in it only the least threatening action is admissible. With `shielded=False` no threat
    is computed and every action is admissible: an MDP with nothing but a penalty on danger.
    """

    params: Any  # the environment's parameters
    threats: dict[str, ThreatModel]  # models by kind of hazard; empty under plans if all are fixed
    x: Array  # () threshold: greatest admissible threat
    penalty: Array  # () subtracted from the reward per unit of danger while learning
    insecure_penalty: Array  # () subtracted for each insecure state that is reached
    env: Env = struct.field(pytree_node=False)  # the environment
    pool: int = struct.field(pytree_node=False, default=8)  # number of LIDAR bins pooled into one
    lookahead: int = struct.field(pytree_node=False, default=0)  # outcomes sampled of each action
    # where a state's own threats admit none; 0: no look-ahead
    shielded: bool = struct.field(pytree_node=False, default=True)  # False: all is admissible

    @property
    def num_actions(self) -> int:
        """The size of the discrete action set."""
        return optional.num_actions(self.env, self.params)

    def perceive(self, states: Any, alive: Array | None = None) -> Percept:
        """Observes a batch of states, and finds the actions that are admissible in them.

        Args:
            states: states, leading axis (B,).
            alive: (B,) bool; where it is False, no threat is computed.
        """
        observation = jax.vmap(self.env.observe, (0, None))(states, self.params)
        bins = optional.lidar_bins(self.env)
        encoded = jax.vmap(encode, (0, None, None))(observation, bins, self.pool)
        threat = self.threat(states, alive)
        threshold = self.thresholds(states)
        mask, secure = jax.vmap(shield.shield)(threat, threshold)
        return Percept(encoded, mask, secure, threat, threshold)

    def thresholds(self, states: Any) -> Array:
        """Returns the largest admissible threat in each state, (B,).

        It is `x`, unless the environment has a function `threshold(state)`.

        Args:
            states: states, leading axis (B,).
        """
        return jax.vmap(optional.threshold, (None, 0, None))(self.env, states, self.x)

    def advance(self, keys: Array, states: Any, actions: Array) -> tuple[Any, Outcome]:
        """Makes one transition of each state of a batch.

        Args:
            keys: (B,) random keys for the environment.
            states: states, leading axis (B,).
            actions: (B,) int, or (B, D) float where they are continuous.

        Returns:
            The states after, and the outcomes of the step.
        """
        return jax.vmap(self.env.step, (0, 0, 0, None))(keys, states, actions, self.params)

    def threat(self, states: Any, alive: Array | None = None) -> Array:
        """Returns the total threats of a batch of states.

        With `lookahead`, in insecure states it is the lesser of the sum over hazards and its
        Bellman backup, which is an upper bound of the danger as well (docs/theory.md).

        Args:
            states: states, leading axis (B,).
            alive: (B,) bool; where it is False, the threats are 0.

        Returns:
            (B, A).
        """
        if not self.shielded:
            shape = (states.time.shape[0], self.num_actions)
            return jnp.zeros(shape)
        summed = self._summed(states, self._static(states.body), alive)
        if self.lookahead == 0:
            return summed

        def closer(rows: Array) -> Array:
            chosen = jax.tree.map(lambda a: a.at[rows].get(mode="clip"), states)
            return jnp.minimum(summed.at[rows].get(mode="clip"), self._backup(chosen))

        insecure = jnp.min(summed, axis=-1) > self.thresholds(states)
        return replace_rows(insecure, summed, closer, chunk=4)

    def _static(self, bodies: Any) -> Array | None:
        """Returns the joint threats of the fixed hazards by plan, (B, K, A); None without plans."""
        model = self.params.body
        if not isinstance(model.baseline, Plans):
            return None
        clearance = lambda position: optional.clearance(self.env, position, self.params)  # noqa: E731
        return static_threat(plan_clearances(bodies, model, clearance))

    def _summed(self, states: Any, static: Array | None, alive: Array | None) -> Array:
        """Returns the sum over hazards (B, A) of their threats (Theorem 3).

        Under several plans it is that of the best plan for each action: the least of several upper
        bounds is an upper bound (docs/theory.md).

        Args:
            states: states, leading axis (B,).
            static: (B, K, A) joint threats of the fixed hazards, from `_static`; None without
                plans.
            alive: (B,) bool; where it is False, the sum is 0.
        """
        hazards = jax.vmap(self.env.hazards, (0, None))(states, self.params)
        if alive is not None:
            hazards = {
                kind: group._replace(present=group.present & alive[:, None])
                for kind, group in hazards.items()
            }
        if static is None and not hazards:
            return jnp.zeros((states.time.shape[0], self.num_actions))
        if static is None:
            return total_threat(self.threats, states.body, hazards)
        if hazards:
            moving = compress_above_one(total_threat(self.threats, states.body, hazards))
            static = static + moving.reshape(static.shape)
        best = jnp.min(static, axis=1)
        return best if alive is None else jnp.where(alive[:, None], best, 0.0)

    def _backup(self, states: Any) -> Array:
        """Returns E[d + min_a' U(s', a')] of each action, (B, A), where U is the sum over hazards.

        The mean is over `lookahead` outcomes, drawn jointly by the environment's own step. Danger
        is not discounted.
        """
        actions = jnp.arange(self.num_actions)

        def outcomes(state: Any) -> Any:
            key = jax.random.fold_in(jax.random.key(OUTCOMES), state.time)
            keys = jax.random.split(key, self.lookahead)
            step = lambda action, key: self.env.step(key, state, action, self.params)  # noqa: E731
            return jax.vmap(jax.vmap(step, (None, 0)), (0, None))(actions, keys)

        reached, outcome = jax.vmap(outcomes)(states)  # (B, A, S)
        flat = lambda a: a.reshape(-1, *a.shape[3:])  # noqa: E731
        # A body's step takes no random numbers, so that one outcome per action is enough.
        bodies = jax.tree.map(lambda a: a[:, :, 0].reshape(-1, *a.shape[3:]), reached.body)
        static = self._static(bodies)
        if static is not None:
            static = jnp.repeat(static, self.lookahead, axis=0)
        going = flat(~outcome.terminated)
        after = self._summed(jax.tree.map(flat, reached), static, going)  # 0 after an end
        danger = flat(outcome.danger) + jnp.min(after, axis=-1)
        return jnp.mean(danger.reshape(outcome.danger.shape), axis=-1)
