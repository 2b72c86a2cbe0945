"""Algorithm 4 on a finite CMDP: Q-learning inside the secure sets.

Actions are chosen by `rp_jax.shield`, as in the deep learner.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax import shield
from rp_jax.tabular.cmdp import FiniteCMDP
from rp_jax.validate import number


class LearnerState(NamedTuple):
    """The learner's state between two steps."""

    values: Array  # (H, S, A) the values Q
    visits: Array  # (H, S, A) int32, how often each value was updated


def init(cmdp: FiniteCMDP) -> LearnerState:
    """Returns a learner with all values 0.

    Args:
        cmdp: the CMDP.
    """
    return LearnerState(jnp.zeros(cmdp.shape), jnp.zeros(cmdp.shape, jnp.int32))


def step(
    key: Array,
    learner: LearnerState,
    cmdp: FiniteCMDP,
    admissible: Array,
    omega: float = 0.7,
) -> LearnerState:
    """Samples one transition and makes one update (Algorithm 4, lines 4 to 11).

    The simulator starts anywhere: time and state are drawn uniformly, and the action uniformly from
    the admissible ones. The learning rate is (1 + visits)^-omega.

    Args:
        key: random key.
        learner: the learner before the step.
        cmdp: the CMDP, from which it only samples.
        admissible: (H, S, A) bool; in insecure states only the least threatening action (lines 7 to
            9).
        omega: exponent of the learning rate, in (0.5, 1].
    """
    horizon, states, _ = cmdp.shape
    at_time, at_state, at_action, at_next = jax.random.split(key, 4)
    t = jax.random.randint(at_time, (), 0, horizon)
    s = jax.random.randint(at_state, (), 0, states)
    a = shield.masked_sample(at_action, admissible[t, s])
    arrival = jax.random.choice(at_next, states, p=cmdp.transition[s, a])
    if cmdp.horizon is None:
        after, last = jnp.asarray(0), jnp.asarray(False)
    else:
        after, last = jnp.minimum(t + 1, horizon - 1), t + 1 == horizon
    best = shield.masked_argmax(learner.values[after, arrival], admissible[after, arrival])
    ahead = jnp.where(last, 0.0, learner.values[after, arrival, best])
    target = cmdp.reward[s, a] + cmdp.gamma * ahead
    rate = (1.0 + learner.visits[t, s, a]) ** -omega
    error = target - learner.values[t, s, a]
    return LearnerState(
        values=learner.values.at[t, s, a].add(rate * error),
        visits=learner.visits.at[t, s, a].add(1),
    )


def learn(
    key: Array, cmdp: FiniteCMDP, admissible: Array, steps: int, omega: float = 0.7
) -> LearnerState:
    """Learns from scratch; may be vmapped over keys for several seeds.

    Args:
        key: random key.
        cmdp: the CMDP, from which it only samples.
        admissible: (H, S, A) bool; in insecure states only the least threatening action.
        steps: number of steps.
        omega: exponent of the learning rate, in (0.5, 1].

    Raises:
        ValueError: `steps` is not a positive integer, or `omega` is out of range.
    """
    number("steps", steps, least=1, integer=True)
    number("omega", omega, above=0.5, most=1)

    def one(learner: LearnerState, key: Array) -> tuple[LearnerState, None]:
        return step(key, learner, cmdp, admissible, omega), None

    return jax.lax.scan(one, init(cmdp), jax.random.split(key, steps))[0]
