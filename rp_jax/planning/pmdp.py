"""The P-MDP as a learner meets it: an environment, its threats, and a threshold."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from rp_jax import shield
from rp_jax.arrays import replace_rows
from rp_jax.copies import parts
from rp_jax.dynamics import Plans
from rp_jax.envs import optional
from rp_jax.envs.contract import Env, Outcome
from rp_jax.planning.percept import Percept, encode
from rp_jax.streams import Stream, key_of_state
from rp_jax.threat.correction import SumCorrection
from rp_jax.threat.model import ThreatModel
from rp_jax.threat.static import compress_above_one, plan_clearances, static_threat
from rp_jax.threat.total import total_threat

AGAIN = 4  # times as many outcomes where a look ahead alone would admit an action
NEGLIGIBLE = 1e-4  # share of the promised danger; less threat than that is booked as it is


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
    correction: SumCorrection | None = None  # of the sum over hazards that models are learned for
    pool: int = struct.field(pytree_node=False, default=8)  # number of LIDAR bins pooled into one
    lookahead: int = struct.field(pytree_node=False, default=0)  # outcomes sampled of each action
    # where a state's own threats admit none; 0: no look-ahead
    refunds: int = struct.field(pytree_node=False, default=0)  # outcomes sampled of each chosen
    # action, to book the danger that it is expected to lead to; 0: its threat is booked
    shielded: bool = struct.field(pytree_node=False, default=True)  # False: all is admissible

    __reduce__ = parts

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
        summed = self._total(states, alive)
        threat = self._closer(states, summed)
        least = jnp.min(threat, axis=-1)
        threshold = jax.vmap(optional.threshold, (None, 0, None, 0))(
            self.env, states, self.x, least
        )
        mask, secure = jax.vmap(shield.shield)(threat, threshold)
        return Percept(encoded, mask, secure, threat, threshold, summed)

    def advance(
        self, keys: Array, states: Any, actions: Array, percept: Percept
    ) -> tuple[Any, Outcome]:
        """Makes one transition of each state of a batch, and settles its budget if it has one.

        Args:
            keys: (B,) random keys for the environment.
            states: states, leading axis (B,).
            actions: (B,) int, or (B, D) float where they are continuous.
            percept: what was perceived of the states.

        Returns:
            The states after, and the outcomes of the step.
        """
        reached, outcome = jax.vmap(self.env.step, (0, 0, 0, None))(
            keys, states, actions, self.params
        )
        if optional.has_budget(self.env):
            assert percept.summed is not None
            summed = _capped(percept.summed)
            threat = jnp.take_along_axis(summed, actions[:, None], axis=-1)[:, 0]
            danger = self._expected(states, actions, threat)
            settle = jax.vmap(self.env.settle)  # type: ignore[attr-defined]
            reached = settle(states, reached, jnp.min(summed, axis=-1), danger)
        return reached, outcome

    def threat(self, states: Any, alive: Array | None = None) -> Array:
        """Returns the total threats of a batch of states.

        With `lookahead`, where the sum over hazards is above the threshold for every action, the
        threat of an action is the lesser of that sum and its Bellman backup, which is an upper
        bound of the danger as well (docs/theory.md).

        Args:
            states: states, leading axis (B,).
            alive: (B,) bool; where it is False, the threats are 0.

        Returns:
            (B, A).
        """
        return self._closer(states, self._total(states, alive))

    def _total(self, states: Any, alive: Array | None) -> Array:
        """Returns the sum over hazards (B, A), 0 without a shield."""
        if not self.shielded:
            return jnp.zeros((states.time.shape[0], self.num_actions))
        return self._summed(states, self._static(states.body), alive)

    def _closer(self, states: Any, summed: Array) -> Array:
        """Returns the sums, lowered to the backups where the least one is above the threshold.

        A backup is a mean over sampled outcomes, and the lowest of many is too low. So an action
        that it alone would admit is looked at again, with `AGAIN` times as many fresh outcomes, and
        has the greater of both means.

        Args:
            states: states, leading axis (B,).
            summed: (B, A) sums over hazards.
        """
        if self.lookahead == 0 or not self.shielded:
            return summed
        level = jax.vmap(optional.lookahead_above, (None, 0, None))(self.env, states, self.x)
        insecure = ~jnp.any(summed <= level[:, None], axis=-1)
        actions = jnp.arange(self.num_actions)

        def take(rows: Array) -> Any:
            return jax.tree.map(lambda a: a.at[rows].get(mode="clip"), states)

        def first(rows: Array) -> Array:
            each = jax.tree.map(lambda a: jnp.repeat(a, len(actions), axis=0), take(rows))
            tried = jnp.tile(actions, len(rows))
            backup = self._backup(each, tried, Stream.LOOKAHEAD, self.lookahead)
            return jnp.minimum(summed.at[rows].get(mode="clip"), backup.reshape(len(rows), -1))

        once = replace_rows(insecure, summed, first, chunk=4)
        doubtful = insecure[:, None] & (once <= level[:, None])
        flat = once.reshape(-1)

        def second(pairs: Array) -> Array:
            again, count = Stream.LOOKAHEAD_AGAIN, AGAIN * self.lookahead
            pairs = jnp.minimum(pairs, len(flat) - 1)
            backup = self._backup(take(pairs // len(actions)), pairs % len(actions), again, count)
            most = summed.reshape(-1).at[pairs].get(mode="clip")
            return jnp.minimum(most, jnp.maximum(flat.at[pairs].get(mode="clip"), backup))

        return replace_rows(doubtful.reshape(-1), flat, second, chunk=4).reshape(once.shape)

    def _expected(self, states: Any, actions: Array, threat: Array) -> Array:
        """Returns the danger that the chosen actions are expected to lead to, (B,), at most 1 each.

        With `refunds` it is an unbiased estimate of E[d + m(s')], from that many outcomes that had
        no part in the choice; else, and where the threat is negligible, it is the threat (B,).
        """
        if self.refunds == 0:
            return threat
        matters = threat > NEGLIGIBLE * jax.vmap(self.env.promised)(states)  # type: ignore[attr-defined]

        def estimated(rows: Array) -> Array:
            take = lambda a: a.at[rows].get(mode="clip")  # noqa: E731
            chosen = jax.tree.map(take, states)
            return self._backup(chosen, take(actions), Stream.ACCOUNT, self.refunds)

        return replace_rows(matters, threat, estimated, chunk=16)

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
            return self._corrected(total_threat(self.threats, states.body, hazards))
        if hazards:
            summed = self._corrected(total_threat(self.threats, states.body, hazards))
            moving = compress_above_one(summed)
            static = static + moving.reshape(static.shape)
        best = jnp.min(static, axis=1)
        return best if alive is None else jnp.where(alive[:, None], best, 0.0)

    def _corrected(self, total: Array) -> Array:
        """Returns sums over hazards, raised where calibration found them too low."""
        return total if self.correction is None else self.correction(total)

    def _backup(self, states: Any, actions: Array, use: Stream, count: int) -> Array:
        """Returns E[d + m(s')] of chosen actions, (R,), where m is the least sum over hazards.

        The mean is over outcomes that the environment's own step draws jointly. Their keys follow
        from the state alone, and are those of nothing else; actions of one state share them. Danger
        is not discounted, and there is none after the end of an episode.

        Args:
            states: states, leading axis (R,).
            actions: (R,) int.
            use: what the outcomes are drawn for.
            count: outcomes of each action.
        """
        # A look ahead compares actions, and needs all shades of threats above 1.
        least = _certain if use == Stream.ACCOUNT else lambda threat: jnp.min(threat, axis=-1)

        def outcomes(state: Any, action: Array) -> Any:
            keys = jax.random.split(key_of_state(state, use), count)
            return jax.vmap(lambda key: self.env.step(key, state, action, self.params))(keys)

        reached, outcome = jax.vmap(outcomes)(states, actions)  # (R, count)
        flat = lambda a: a.reshape(-1, *a.shape[2:])  # noqa: E731
        # A body's step takes no random numbers, so that one outcome is enough for it.
        static = self._static(jax.tree.map(lambda a: a[:, 0], reached.body))
        if static is not None:
            static = jnp.repeat(static, count, axis=0)
        going = flat(~outcome.done)
        after = self._summed(jax.tree.map(flat, reached), static, going)  # 0 after an end
        danger = flat(outcome.danger) + least(after)
        return jnp.mean(danger.reshape(outcome.danger.shape), axis=-1)


def _capped(threat: Array) -> Array:
    """Returns threats as probabilities: a sum may be greater than 1, what it bounds may not."""
    return jnp.minimum(threat, 1.0)


def _certain(threat: Array) -> Array:
    """Returns the least danger (B,) that threats (B, A) leave, at most 1."""
    return jnp.min(_capped(threat), axis=-1)
