"""Constrained Policy Optimization (Achiam et al. 2017; appendix G.3)."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlib
from flax import linen as nn
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.scipy.sparse.linalg import cg

from rp_jax.baselines import actor_critic
from rp_jax.baselines.actor_critic import DANGER, REWARD, ActorCriticConfig, ActorCriticState, Batch
from rp_jax.planning.pmdp import PMDP
from rp_jax.validate import number

ENOUGH = 1e-5  # relative residual that ends conjugate gradients; below it, rounding gives 0 / 0
TINY = 1e-12  # least denominator, so that quotients stay finite
UNCONSTRAINED, CONSTRAINED, RECOVERY = range(3)  # how a step was chosen


@dataclass(frozen=True)
class CPOConfig:
    """Hyperparameters of the learner."""

    # The gradient of rare danger needs larger batches than PPO does.
    rollout: ActorCriticConfig = field(default_factory=lambda: ActorCriticConfig(num_envs=256))
    divergence: float = 0.01  # delta, the trust region: greatest mean KL divergence of an update
    damping: float = 0.01  # added to the diagonal of the Fisher matrix
    products: int = 10  # number of conjugate gradient iterations
    backtracks: int = 15  # number of attempts of the line search
    shrink: float = 0.8  # factor of the step's length from one attempt to the next

    def validate(self, name: str) -> None:
        """Raises ValueError, naming the field after `name`, if a value is out of range."""
        self.rollout.validate(f"{name}.rollout")
        number(f"{name}.divergence", self.divergence, above=0)
        number(f"{name}.damping", self.damping, least=0)
        number(f"{name}.products", self.products, least=1, integer=True)
        number(f"{name}.backtracks", self.backtracks, least=1, integer=True)
        number(f"{name}.shrink", self.shrink, above=0, most=1)


class Update(NamedTuple):
    """The result of an update."""

    kl: Array  # () mean divergence of the new policy from the old one
    case: Array  # () int: UNCONSTRAINED, CONSTRAINED or RECOVERY
    accepted: Array  # () bool, the line search found a step


class CPOMetrics(NamedTuple):
    """CPOMetrics of one step of the learner."""

    rollout: actor_critic.ActorCriticMetrics
    update: Update


def compiler_options() -> dict[str, str]:
    """Returns the options that `step` or `improve` must be compiled with.

    They belong to `jax.jit(..., compiler_options=...)`. On a CPU, jaxlib 0.10 fuses some products
    for YNNPACK wrongly: on large batches the conjugate gradients come out as nan or worse, and the
    line search then accepts no step.
    """
    wrong = jax.default_backend() == "cpu" and jaxlib.__version__.startswith("0.10.")
    return {"xla_cpu_experimental_ynn_fusion_type": ""} if wrong else {}


def fisher_product(
    policy: Callable[[Array], Any], theta: Array, damping: float
) -> Callable[[Array], Array]:
    """Returns the function that multiplies a vector (P,) by the damped Fisher matrix.

    The matrix is J'MJ, the Hessian of the mean KL divergence from the policy at `theta`: J is the
    Jacobian of the distributions' parameters, and M the Hessian of the divergence in these.

    Args:
        policy: maps weights (P,) to the distributions of a batch of states.
        theta: (P,) weights.
        damping: added to the diagonal.
    """
    old, push = jax.linearize(policy, theta)
    pull = jax.linear_transpose(push, theta)
    slope = jax.grad(lambda new: jnp.mean(old.kl(new)))

    def product(vector: Array) -> Array:
        _, bent = jax.jvp(slope, (old,), (push(vector),))
        return pull(bent)[0] + damping * vector

    return product


def step_lengths(
    q: Array, r: Array, s: Array, excess: Array, delta: float, reach: Array | None = None
) -> tuple[Array, Array, Array]:
    """Solves max g'x subject to excess + b'x <= 0 and x'Hx / 2 <= delta, by its dual.

    With v = H^-1 g and w = H^-1 b the solution is x = along v - against w, where `along` is 1 /
    lambda and `against` is nu / lambda in the dual's multipliers. If the best step of the trust
    region keeps the constraint, nu is 0; otherwise the best step lies on both boundaries. If no
    step of the trust region keeps it, x reduces the danger as fast as possible (the recovery step
    of Achiam et al.).

    Args:
        q: () g'v.
        r: () g'w.
        s: () b'w.
        excess: () by how much the constraint is violated; negative where it is kept.
        delta: radius of the trust region.
        reach: () estimate of s to decide whether any step of the region keeps the constraint; s by
            default.

    Returns:
        (along, against, case), () each.
    """
    reach = s if reach is None else reach
    free = jnp.sqrt(2 * delta / jnp.maximum(q, TINY))
    slope = r / jnp.maximum(s, TINY)
    # What the trust region leaves for steps along the constraint.
    left, surely = (2 * delta - excess * excess / jnp.maximum(a, TINY) for a in (s, reach))
    gain = jnp.maximum(q - r * slope, TINY)  # of reward along the constraint
    bound = jnp.sqrt(jnp.maximum(left, 0.0) / gain)
    case = jnp.where(
        excess + free * r <= 0,
        UNCONSTRAINED,
        jnp.where((excess > 0) & (surely < 0), RECOVERY, CONSTRAINED),
    )
    along = jnp.stack([free, bound, jnp.zeros_like(free)])
    against = jnp.stack(
        [
            jnp.zeros_like(free),
            bound * slope + excess / jnp.maximum(s, TINY),
            jnp.sqrt(2 * delta / jnp.maximum(s, TINY)),
        ]
    )
    return along[case], against[case], case


def improve(
    params: Any, network: nn.Module, batch: Batch, excess: Array, config: CPOConfig
) -> tuple[Any, Update]:
    """Makes one update of the policy (Algorithm 1 of Achiam et al.).

    To be compiled with `compiler_options`. The product s = b'H^-1 b says how far a step can lower
    the danger, and noise in b adds to it: where crashes are rare, a step would seem to keep a
    constraint that it does not come near to, and the danger would stay. So whether to recover is
    decided with b of two halves of the batch, b1'H^-1 b2, which noise does not raise. The halves
    take alternate rows, and so different environments if the number of these is even.

    Args:
        params: weights of the policy.
        network: the policy network.
        batch: steps of this policy.
        excess: () by how much the danger per step exceeds the limit.
        config: hyperparameters.

    Returns:
        The new weights, and a summary of the update.
    """
    theta, unravel = ravel_pytree(params)

    def policy(theta: Array) -> Any:
        return network.apply(unravel(theta), batch.encoded)

    old = policy(theta)
    before = old.log_prob(batch.action)
    advantage = batch.advantage - jnp.mean(batch.advantage, axis=0, keepdims=True)

    def surrogates(theta: Array) -> Array:
        """Returns how reward and danger per step change, (2,)."""
        ratio = jnp.exp(policy(theta).log_prob(batch.action) - before)
        return jnp.mean(ratio[:, None] * advantage, axis=0)

    def dangers(theta: Array) -> Array:
        """Returns how danger per step changes, (2,), from the even and from the odd rows."""
        change = jnp.exp(policy(theta).log_prob(batch.action) - before) * advantage[:, DANGER]
        return jnp.stack([jnp.mean(change[::2]), jnp.mean(change[1::2])])

    def divergence(theta: Array) -> Array:
        return jnp.mean(old.kl(policy(theta)))

    g, b = jax.jacrev(surrogates)(theta)
    even, odd = jax.jacrev(dangers)(theta)
    product = fisher_product(policy, theta, config.damping)
    v, w, u = (cg(product, a, tol=ENOUGH, maxiter=config.products)[0] for a in (g, b, even))
    along, against, case = step_lengths(g @ v, g @ w, b @ w, excess, config.divergence, odd @ u)
    direction = along * v - against * w

    def attempt(carry):
        count, *_ = carry
        new = theta + config.shrink**count * direction
        change, kl = surrogates(new), divergence(new)
        # Danger may rise up to the limit, and not at all above it; reward may fall to get there.
        fine = (kl <= config.divergence) & (change[DANGER] <= jnp.maximum(-excess, 0.0))
        fine &= (change[REWARD] >= 0) | (excess > 0)
        return count + 1, jnp.where(fine, new, theta), jnp.where(fine, kl, 0.0), fine

    def going(carry):
        count, *_, fine = carry
        return ~fine & (count < config.backtracks)

    begin = (jnp.asarray(0), theta, jnp.zeros_like(excess), jnp.asarray(False))
    _, theta, kl, accepted = jax.lax.while_loop(going, attempt, begin)
    return unravel(theta), Update(kl, case, accepted)


def init(key: Array, pmdp: PMDP, config: CPOConfig) -> ActorCriticState:
    """Starts all environments, a policy and a critic.

    Args:
        key: random key for starts, weights and learning.
        pmdp: the environment.
        config: hyperparameters.
    """
    return actor_critic.init(key, pmdp, config.rollout)


def step(
    state: ActorCriticState, pmdp: PMDP, limit: Array, config: CPOConfig
) -> tuple[ActorCriticState, CPOMetrics]:
    """Collects a batch, then improves policy and critic.

    To be compiled with `compiler_options`.

    Args:
        state: the learner's state.
        pmdp: the environment, not shielded. Its penalty is subtracted from the rewards.
        limit: () greatest expected danger of an episode, not discounted; may be swept by `vmap`.
        config: hyperparameters.

    Returns:
        The learner's state after the step, and metrics.
    """
    key, collect_key, fit_key = jax.random.split(state.key, 3)
    state, batch, metrics = actor_critic.collect(collect_key, state, pmdp, config.rollout)
    # The limit holds for an episode, while advantages belong to a step: both are compared per step.
    # A single batch may hold less than one crash where the limit is kept.
    recent = state.recent
    excess = (recent.danger - limit * recent.episodes) / recent.steps
    network = actor_critic.make_actor(pmdp, config.rollout)
    actor, update = improve(state.actor, network, batch, excess, config)

    def learn(state: ActorCriticState, part: Batch) -> ActorCriticState:
        return actor_critic.update_critic(state, part, pmdp, config.rollout)

    state = state._replace(actor=actor, key=key)
    state = actor_critic.pass_over(fit_key, state, batch, learn, config.rollout)
    return state, CPOMetrics(metrics, update)
