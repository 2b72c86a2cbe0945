"""Every theorem of docs/theory.md, checked on CMDPs against the exact worst policy.

Each check takes one instance and returns by how much it is violated, at most rounding if the
theorem holds; callers vmap. Names of other modules are looked up when a check is traced, so a
test can put a wrong implementation in place of a right one and see the check fail.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.tabular import factored, secure, threat, thresholds
from rp_jax.tabular.cmdp import FiniteCMDP

BETAS = (0.0, 0.5, 0.9, 0.999, 1 - 1e-6, 1.0)
NEAR_1 = 1 - 1e-4  # without end: nearer to 1, double precision itself errs by more than is allowed


class Instance(NamedTuple):
    """A CMDP, a baseline policy eta, a threshold, a bound, and another policy."""

    cmdp: FiniteCMDP
    eta: Array  # (H, S, A)
    other: Array  # (H, S, A)
    x: Array  # ()
    share: Array  # () in [0, 2), from which `_bound` makes c
    noise: Array  # (H, S, A) in [0, 1)


def draw(key: Array, states: int, actions: int, horizon: int | None) -> Instance:
    """A random instance of sparse transitions, with ties, absorbing states and free actions.

    beta is one of BETAS or uniform; x is 0, a value of the threat itself or just below one, or
    uniform. In a share of the instances the bounds are reached: eta takes a free action, all
    others cost the same.
    """
    keys = iter(jax.random.split(key, 24))
    shape = (states, actions, states)
    h = horizon or 1

    def chance(p: float, *shape: int) -> Array:
        return jax.random.bernoulli(next(keys), p, shape)

    def simplex(key: Array, sparse: Array) -> Array:
        """Rows that sum to 1, with zeros, some of them deterministic."""
        weight = jax.random.exponential(key, sparse.shape)
        kept = jnp.where(sparse, weight, 0.0)
        kept = jnp.where(kept.sum(-1, keepdims=True) > 0, kept, weight)
        return kept / kept.sum(-1, keepdims=True)

    kernel = simplex(next(keys), chance(0.5, *shape))
    absorbing = chance(0.15, states)[:, None, None]
    kernel = jnp.where(absorbing, jnp.eye(states)[:, None], kernel)
    danger = jax.random.uniform(next(keys), shape[:2]) * chance(0.4, *shape[:2])
    danger = jnp.where(chance(0.5), jnp.round(2 * danger) / 2, danger)  # many ties
    reached = chance(0.15)
    free = jnp.zeros(shape[:2]).at[:, 0].set(1.0)
    danger = jnp.where(reached, jax.random.uniform(next(keys)) * (1 - free), danger)
    beta = jnp.where(
        chance(0.7),
        jax.random.choice(next(keys), jnp.asarray(BETAS)),
        jax.random.uniform(next(keys)),
    )
    if horizon is None:
        beta = jnp.minimum(beta, NEAR_1)
    cmdp = FiniteCMDP(
        transition=kernel,
        reward=jnp.zeros(shape[:2]),
        danger=danger,
        start=simplex(next(keys), jnp.ones(states, bool)),
        gamma=beta,
        beta=beta,
        horizon=horizon,
    )
    eta, other = simplex(next(keys), chance(0.6, 2, h, *shape[:2]))
    eta = jnp.where(reached, free[None], eta)
    found = threat.threat(cmdp, eta).action
    spread = jax.random.uniform(next(keys), maxval=found.max())
    at_value = jax.random.choice(next(keys), found.ravel()) * jnp.where(chance(0.3), 0.95, 1.0)
    pick = jax.random.uniform(next(keys))
    return Instance(
        cmdp=cmdp,
        eta=eta,
        other=other,
        x=jnp.select([pick < 0.1, pick < 0.5], [0.0, at_value], spread),
        share=jax.random.uniform(next(keys), maxval=2.0),
        noise=jax.random.uniform(next(keys), found.shape),
    )


def _worst_drift(
    cmdp: FiniteCMDP, x: Array, at_secure: Callable, elsewhere: Callable, data: tuple
) -> Array:
    """(H, S) max over policies of E[sum beta^k (d_k - x z_k)]; z is 0 where it is not secure."""

    def back(after: Array, now: tuple) -> tuple[Array, Array]:
        allowed, given = now
        action = cmdp.danger + cmdp.beta * (cmdp.transition @ after)
        inside = at_secure(action, allowed.admissible, given, x)
        state = jnp.where(allowed.secure, inside, elsewhere(action, given))
        return state, state

    return jax.lax.scan(back, jnp.zeros(cmdp.shape[1]), data, reverse=True)[1]


def _drifting(action: Array, admissible: Array, eta: Array, x: Array) -> Array:
    """(S,) max over p inside the set of p.Q - x d_TV(p, eta): concave, so not at a corner.

    Where eta itself goes, mass is free of charge up to eta's own; all else costs x, and goes to
    the best action.
    """
    best = jnp.max(jnp.where(admissible, action, -jnp.inf), axis=1) - x
    kept = jnp.where(admissible, eta, 0.0)
    return jnp.sum(kept * jnp.maximum(action, best[:, None]), axis=1) + best * (1 - kept.sum(1))


def theorem_1(case: Instance) -> Array:
    """D^pi <= D^eta + sum beta^{k-t} x E[z_k] for all pi in Pi_G, with factor 1 (finite T)."""
    cmdp, eta, x = case.cmdp, case.eta, case.x
    found = threat.threat(cmdp, eta)

    def outside(action: Array, given: tuple) -> Array:
        """(S,) max of p.Q over p with p.T <= D: a corner, or a mixture of two actions."""
        _, t, d = given
        low, high, d = t[:, :, None], t[:, None, :], d[:, None, None]
        crossing = (low <= d) & (high > d)
        share = jnp.where(crossing, (d - low) / jnp.where(crossing, high - low, 1.0), 0.0)
        mixture = (1 - share) * action[:, :, None] + share * action[:, None, :]
        return jnp.max(jnp.where(low <= d, mixture, -jnp.inf), axis=(1, 2))

    def inside(action: Array, admissible: Array, given: tuple, x: Array) -> Array:
        return _drifting(action, admissible, given[0], x)

    data = (secure.secure(found.action, x), (eta, found.action, found.state + 1e-12))
    reached = _worst_drift(cmdp, x, inside, outside, data)
    return jnp.max(reached - found.state)


def theorem_2(case: Instance) -> Array:
    """D^pi <= D^greedy + sum beta^{k-t} x E[z^g_k] for all pi in Pi (finite T)."""
    cmdp, x = case.cmdp, case.x
    found = threat.threat(cmdp, case.eta)
    greedy = threat.greedy(found.action)

    def outside(action: Array, greedy: Array) -> Array:
        return jnp.sum(greedy * action, axis=1)

    data = (secure.secure(found.action, x), greedy)
    reached = _worst_drift(cmdp, x, _drifting, outside, data)
    improved = threat.threat(cmdp, greedy).state
    return jnp.maximum(jnp.max(reached - improved), jnp.max(improved - found.action.min(axis=-1)))


def _danger(case: Instance, values: threat.Values) -> Array:
    return threat.expected(case.cmdp, values)


def _bound(case: Instance, danger: Array) -> Array:
    """() c: at or below the danger, or above it by what makes x the instance's own."""
    steps = jnp.sum(case.cmdp.beta ** jnp.arange(case.cmdp.horizon or 0))
    steps = steps if case.cmdp.horizon is not None else 1 / (1 - case.cmdp.beta)
    return jnp.where(case.share < 0.5, 2 * case.share * danger, danger + case.x * steps)


def corollary_1(case: Instance) -> Array:
    """With its x, the worst policy of Pi_G keeps c; below E[D^eta] there is no x >= 0."""
    cmdp = case.cmdp
    found = threat.threat(cmdp, case.eta)
    c = _bound(case, _danger(case, found))
    x = thresholds.corollary_1(cmdp, case.eta, c)
    allowed = secure.secure(found.action, x)
    # Outside the secure states, eta is in F^eta, and no member of it is worse (Theorem 1).
    sets = jnp.where(allowed.secure[..., None], allowed.admissible, False)

    def choose(action: Array, given: tuple) -> Array:
        inside, eta = given
        some = inside.any(axis=1, keepdims=True)
        return jnp.where(some, secure.most(action, inside | ~some), eta)

    reached = threat.solve(cmdp, cmdp.danger, cmdp.beta, choose, (sets, case.eta))
    unsafe = _danger(case, found) > c
    broken = _danger(case, reached) - c
    return jnp.where(unsafe, jnp.where(x < 0, 0.0, 1.0), broken)


def corollary_2(case: Instance) -> Array:
    """With its x, the worst policy of Pi keeps c; and with the intersection of equation 5."""
    cmdp = case.cmdp
    found = threat.threat(cmdp, case.eta)
    safest = _danger(case, threat.threat(cmdp, threat.greedy(found.action)))
    c = _bound(case, safest)
    x = thresholds.corollary_2(cmdp, case.eta, c)
    broken = [
        _danger(case, secure.worst(cmdp, rule(found.action, x).admissible)) - c
        for rule in (secure.secure, secure.secure_at_all_times)
    ]
    return jnp.where(safest > c, jnp.where(x < 0, 0.0, 1.0), jnp.maximum(*broken))


def corollary_3(case: Instance) -> Array:
    """eta* is safe whenever any policy is, and so is all of its Pi."""
    cmdp = case.cmdp
    star = threat.least_threat(cmdp)
    others = [threat.threat(cmdp, policy).state for policy in (case.eta, case.other)]
    c = jnp.maximum(_danger(case, star), _bound(case, _danger(case, star)))
    x = thresholds.corollary_2(cmdp, star.policy, c)
    reached = secure.worst(cmdp, secure.secure(star.action, x).admissible)
    beaten = jnp.max(star.state - jnp.minimum(*others))
    return jnp.maximum(beaten, jnp.maximum(_danger(case, reached) - c, -x))


def certificate(case: Instance) -> Array:
    """Its bound holds at every state, for U above or below the threat, and so does its x."""
    cmdp, x = case.cmdp, case.x
    found = threat.threat(cmdp, case.eta).action
    broken = []
    for upper in (found, found + 0.3 * case.noise, found * case.noise, case.noise):
        proved = thresholds.certificate(cmdp, upper, x)
        reached = secure.worst(cmdp, secure.secure(upper, x).admissible)
        c = _bound(case, cmdp.start @ proved.least[0])
        fixed = thresholds.certified(cmdp, upper, c)
        inside = secure.worst(cmdp, secure.secure(upper, fixed).admissible)
        over = jnp.where(fixed >= 0, _danger(case, inside) - c, 0.0)
        broken += [jnp.max(reached.state - proved.state), over]
    return jnp.max(jnp.stack(broken))


def advantage(case: Instance) -> Array:
    """{a : T - D <= y} keeps D^pi <= D^eta + y sum beta^k."""
    cmdp, y = case.cmdp, case.x
    found = threat.threat(cmdp, case.eta)
    reached = secure.worst(cmdp, secure.secure_by_advantage(found, y).admissible)
    steps = threat.evaluate(cmdp, jnp.ones_like(cmdp.danger), cmdp.beta, case.eta).state
    return jnp.max(reached.state - found.state - y * steps)


def evaluated(case: Instance) -> Array:
    """The evaluated x keeps c at its worst policy, and the next greater value does not."""
    cmdp = case.cmdp
    found = threat.threat(cmdp, case.eta).action
    safest = _danger(case, threat.threat(cmdp, threat.greedy(found)))
    c = safest + case.share * jnp.maximum(0.2, safest)
    x = thresholds.evaluated(cmdp, found, c)
    beyond = jnp.min(jnp.where(found > x, found, jnp.inf))

    def danger(x: Array) -> Array:
        return _danger(case, secure.worst(cmdp, secure.secure(found, x).admissible))

    most = thresholds.corollary_2(cmdp, case.eta, c)
    behind = jnp.max(jnp.where(found <= most - 1e-9, found, -jnp.inf)) - x
    early = jnp.where(jnp.isfinite(beyond) & (danger(beyond) <= c - 1e-9), 1.0, 0.0)
    return jnp.max(jnp.stack([danger(x) - c, early, behind]))


CHECKS: dict[str, Callable[[Instance], Array]] = {
    "theorem 1": theorem_1,
    "theorem 2": theorem_2,
    "corollary 1": corollary_1,
    "corollary 2": corollary_2,
    "corollary 3": corollary_3,
    "certificate": certificate,
    "advantage": advantage,
    "evaluated": evaluated,
}

FINITE = ("theorem 1", "theorem 2")  # z is counted step by step: for a finite horizon only


def draw_factored(
    key: Array, states: int, actions: int, hazards: int, horizon: int | None
) -> tuple[factored.Factored, Array]:
    """A random factored model of `states` states of agent and of each hazard, and eta^(o)."""
    keys = iter(jax.random.split(key, 4 + 3 * hazards))

    def simplex(*shape: int) -> Array:
        return jax.random.dirichlet(next(keys), jnp.full(shape[-1], 0.5), shape[:-1])

    beta = jax.random.choice(next(keys), jnp.asarray(BETAS))
    model = factored.Factored(
        agent=simplex(states, actions, states),
        start=simplex(states),
        hazards=[
            factored.Hazard(
                transition=simplex(states, actions, states, states),
                hits=jax.random.bernoulli(next(keys), 0.3, (states, states, actions)).astype(float),
                start=simplex(states),
            )
            for _ in range(hazards)
        ],
        beta=beta if horizon is not None else jnp.minimum(beta, NEAR_1),
        horizon=horizon,
    )
    return model, simplex(horizon or 1, states, actions)


def theorem_3(model: factored.Factored, eta: Array) -> Array:
    """T^eta <= sum_n T^{eta,n} at every joint state, step and action; a share as `violation`."""
    whole = threat.threat(factored.joint(model), factored.lifted(model, eta)).action
    total = factored.summed(model, factored.sub_threats(model, eta))
    return jnp.max(whole - total) / thresholds.effective_horizon(model.beta, model.horizon)


def violations(key: Array, states: int, actions: int, horizon: int | None) -> dict[str, Array]:
    """By check, by how much it is violated on one random instance.

    As a share of the greatest danger an episode can have, so that rounding looks alike for all.
    """
    case = draw(key, states, actions, horizon)
    most = thresholds.effective_horizon(case.cmdp.beta, horizon)
    checks = [name for name in CHECKS if horizon is not None or name not in FINITE]
    return {name: CHECKS[name](case) / most for name in checks}


def violations_of_theorem_3(
    key: Array, states: int, actions: int, hazards: int, horizon: int | None
) -> dict[str, Array]:
    """As `violations`, on one random factored model."""
    return {"theorem 3": theorem_3(*draw_factored(key, states, actions, hazards, horizon))}
