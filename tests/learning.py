"""What tests of on-policy learners share: sizes for tiny problems, and exact evaluation."""

import finite
import jax.numpy as jnp

from rp_jax.baselines import actor_critic
from rp_jax.baselines.actor_critic import ActorCriticConfig
from rp_jax.tabular import exact

ROLLOUT = ActorCriticConfig(
    policy="categorical",
    num_envs=64,
    length=32,
    gamma=1.0,
    critic_rate=3e-3,
    epochs=5,
    minibatches=4,
    memory=0.0,
)


def danger_and_return(model, pmdp, actor):
    """Of a learned policy on a finite CMDP, exactly."""
    network = actor_critic.make_actor(pmdp, ROLLOUT)
    encoded = pmdp.perceive(finite.all_states(model)).encoded
    policy = jnp.exp(network.apply(actor, encoded).log_probs).reshape(model.shape)
    harm, gain = exact.threat(model, policy), exact.returns(model, policy)
    return float(exact.expected(model, harm)), float(exact.expected(model, gain))
