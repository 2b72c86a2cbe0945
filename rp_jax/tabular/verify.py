"""All theorems of docs/theory.md, checked on CMDPs against the exact most dangerous policy.

Each check takes one instance and returns by how much the theorem is violated: no more than rounding
errors if it holds. Callers vmap. Names of other modules are looked up when a check is traced, so
that a test can replace a right implementation by a wrong one and see the check fail.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rp_jax.tabular import budgets, exact, factored, secure, thresholds
from rp_jax.tabular.cmdp import FiniteCMDP

BETAS = (0.0, 0.5, 0.9, 0.999, 1 - 1e-6, 1.0)
NEAR_1 = 1 - 1e-4  # greatest beta without a horizon: nearer to 1, rounding errors are too large


class Instance(NamedTuple):
    """An instance for the checks: a CMDP, two policies, and numbers for thresholds and bounds."""

    cmdp: FiniteCMDP
    eta: Array  # (H, S, A) the baseline policy
    other: Array  # (H, S, A) another policy
    x: Array  # (H,) thresholds
    share: Array  # () in [0, 2), from which `_bound` makes c
    noise: Array  # (H, S, A) in [0, 1)


def draw(key: Array, states: int, actions: int, horizon: int | None) -> Instance:
    """Draws an instance with sparse transitions, ties, absorbing states and actions without danger.

    beta is one of `BETAS` or uniform. x is 0, a value of the threat itself or just below one, or
    uniform; in some of the instances it differs from step to step. In some the bounds are attained:
    eta takes an action without danger, and all others have the same danger.

    Args:
        key: random key.
        states: number of states.
        actions: number of actions.
        horizon: number of steps, or None for the infinite horizon.
    """
    keys = iter(jax.random.split(key, 28))
    shape = (states, actions, states)
    h = horizon or 1

    def chance(p: float, *shape: int) -> Array:
        return jax.random.bernoulli(next(keys), p, shape)

    def simplex(key: Array, sparse: Array) -> Array:
        """Draws rows that sum to 1, with zeros; some of them are deterministic."""
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
    start = simplex(next(keys), jnp.ones(states, bool))
    start = jnp.where(chance(0.3), jnp.eye(states)[0], start)
    cmdp = FiniteCMDP(
        transition=kernel,
        reward=jnp.zeros(shape[:2]),
        danger=danger,
        start=start,
        gamma=beta,
        beta=beta,
        horizon=horizon,
    )
    eta, other = simplex(next(keys), chance(0.6, 2, h, *shape[:2]))
    eta = jnp.where(reached, free[None], eta)
    found = exact.threat(cmdp, eta).action
    spread = jax.random.uniform(next(keys), maxval=found.max())
    at_value = jax.random.choice(next(keys), found.ravel()) * jnp.where(chance(0.3), 0.95, 1.0)
    at_value = jnp.where(chance(0.2), jnp.nextafter(at_value, -jnp.inf), at_value)
    pick = jax.random.uniform(next(keys))
    x = jnp.select([pick < 0.1, pick < 0.5], [0.0, at_value], spread)
    by_step = jax.random.uniform(next(keys), (h,), maxval=2.0)
    x = x * jnp.where(chance(0.3), by_step, jnp.ones(h))
    return Instance(
        cmdp=cmdp,
        eta=eta,
        other=other,
        x=x,
        share=jax.random.uniform(next(keys), maxval=2.0),
        noise=jax.random.uniform(next(keys), found.shape),
    )


def _worst_drift(
    cmdp: FiniteCMDP, x: Array, at_secure: Callable, elsewhere: Callable, data: tuple
) -> Array:
    """Returns max E[sum beta^k (d_k - x_k z_k)] over policies, (H, S); z is 0 where insecure."""

    def back(after: Array, now: tuple) -> tuple[Array, Array]:
        (allowed, given), x = now
        action = cmdp.danger + cmdp.beta * (cmdp.transition @ after)
        inside = at_secure(action, allowed.admissible, given, x)
        state = jnp.where(allowed.secure, inside, elsewhere(action, given))
        return state, state

    return jax.lax.scan(back, jnp.zeros(cmdp.shape[1]), (data, x), reverse=True)[1]


def _riskiest(action: Array, threats: Array, most: Array) -> Array:
    """Returns the policy of the greatest p.Q among those with p.T <= most, (S, A).

    These policies are F^eta of equation 6. The problem is a linear program with one constraint,
    solved by one action or a mixture of two.

    Args:
        action: (S, A) values Q.
        threats: (S, A) threats T.
        most: (S,) bound.
    """
    actions = action.shape[1]
    low, high, most = threats[:, :, None], threats[:, None, :], most[:, None, None]
    crossing = (low <= most) & (high > most)
    share = jnp.where(crossing, (most - low) / jnp.where(crossing, high - low, 1.0), 0.0)
    mixed = (1 - share) * action[:, :, None] + share * action[:, None, :]
    best = jnp.argmax(jnp.where(low <= most, mixed, -jnp.inf).reshape(-1, actions**2), axis=1)
    part = jnp.take_along_axis(share.reshape(-1, actions**2), best[:, None], axis=1)
    one, other = jnp.divmod(best, actions)
    hot = lambda i: jax.nn.one_hot(i, actions, dtype=action.dtype)  # noqa: E731
    return (1 - part) * hot(one) + part * hot(other)


def _drifting(action: Array, admissible: Array, eta: Array, x: Array) -> Array:
    """Returns the maximum of p.Q - x d_TV(p, eta) over policies p inside the sets, (S,).

    The function is concave, so that its maximum need not be at a corner. Probability is free of
    charge up to eta's own; all else costs x, and goes to the best action.
    """
    best = jnp.max(jnp.where(admissible, action, -jnp.inf), axis=1) - x
    kept = jnp.where(admissible, eta, 0.0)
    return jnp.sum(kept * jnp.maximum(action, best[:, None]), axis=1) + best * (1 - kept.sum(1))


SETS = ("secure", "secure_at_all_times")  # sets of each step, and of all steps (equation 5)


def theorem_1(case: Instance) -> Array:
    """Checks D^pi <= D^eta + sum beta^{k-t} x_k E[z_k] for all pi in Pi_G, with factor 1.

    Args:
        case: an instance with a finite horizon.

    Returns:
        () the violation.
    """
    cmdp, eta, x = case.cmdp, case.eta, case.x
    found = exact.threat(cmdp, eta)

    def outside(action: Array, given: tuple) -> Array:
        _, threats, most = given
        return jnp.sum(_riskiest(action, threats, most) * action, axis=1)

    def inside(action: Array, admissible: Array, given: tuple, x: Array) -> Array:
        return _drifting(action, admissible, given[0], x)

    given = (eta, found.action, found.state + 1e-12)
    broken = []
    for rule in SETS:
        data = (getattr(secure, rule)(found.action, x), given)
        broken.append(jnp.max(_worst_drift(cmdp, x, inside, outside, data) - found.state))
    return jnp.maximum(*broken)


def theorem_2(case: Instance) -> Array:
    """Checks D^pi <= D^greedy + sum beta^{k-t} x_k E[z^g_k] for all pi in Pi, with factor 1.

    Args:
        case: an instance with a finite horizon.

    Returns:
        () the violation.
    """
    cmdp, x = case.cmdp, case.x
    found = exact.threat(cmdp, case.eta)
    greedy = exact.greedy(found.action)
    improved = exact.threat(cmdp, greedy).state

    def outside(action: Array, greedy: Array) -> Array:
        return jnp.sum(greedy * action, axis=1)

    broken = [jnp.max(improved - found.action.min(axis=-1))]
    for rule in SETS:
        data = (getattr(secure, rule)(found.action, x), greedy)
        broken.append(jnp.max(_worst_drift(cmdp, x, _drifting, outside, data) - improved))
    return jnp.max(jnp.stack(broken))


def _danger(case: Instance, values: exact.Values) -> Array:
    """Returns the expected danger of an episode, ()."""
    return exact.expected(case.cmdp, values)


def _steps(cmdp: FiniteCMDP) -> Array:
    """Returns the sum of beta^k, (), added term by term."""
    if cmdp.horizon is None:
        return 1 / (1 - cmdp.beta)
    return jnp.sum(cmdp.beta ** jnp.arange(cmdp.horizon))


def _bound(case: Instance, danger: Array) -> Array:
    """Returns a bound c, ().

    In a tenth of the instances it is below the given danger; in the others, above it by what makes
    x[0] the threshold.
    """
    above = danger + case.x[0] * _steps(case.cmdp)
    return jnp.where(case.share < 0.2, 5 * case.share * danger, above)


def corollary_1(case: Instance) -> Array:
    """Checks that under Corollary 1's x the most dangerous policy of Pi_G keeps c.

    Below E[D^eta] there must be no x >= 0.

    Args:
        case: an instance.

    Returns:
        () the violation.
    """
    cmdp = case.cmdp
    found = exact.threat(cmdp, case.eta)
    c = _bound(case, _danger(case, found))
    x = thresholds.corollary_1(cmdp, case.eta, c)

    def choose(action: Array, given: tuple) -> Array:
        allowed, threats, most = given
        inside = secure.most(action, allowed.admissible)
        return jnp.where(allowed.secure[:, None], inside, _riskiest(action, threats, most))

    broken = []
    for rule in SETS:
        data = (getattr(secure, rule)(found.action, x), found.action, found.state + 1e-12)
        reached = exact.solve(cmdp, cmdp.danger, cmdp.beta, choose, data)
        broken.append(_danger(case, reached) - c)
    unsafe = _danger(case, found) > c
    return jnp.where(unsafe, jnp.where(x < 0, 0.0, 1.0), jnp.maximum(*broken))


def corollary_2(case: Instance) -> Array:
    """Checks that under Corollary 2's x the most dangerous policy of Pi keeps c.

    It is also checked for the intersections of equation 5. Below the danger of greedy-eta there
    must be no x >= 0.

    Args:
        case: an instance.

    Returns:
        () the violation.
    """
    cmdp = case.cmdp
    found = exact.threat(cmdp, case.eta)
    safest = _danger(case, exact.threat(cmdp, exact.greedy(found.action)))
    c = _bound(case, safest)
    x = thresholds.corollary_2(cmdp, case.eta, c)
    broken = [
        _danger(case, secure.worst(cmdp, getattr(secure, rule)(found.action, x).admissible)) - c
        for rule in SETS
    ]
    return jnp.where(safest > c, jnp.where(x < 0, 0.0, 1.0), jnp.maximum(*broken))


def corollary_3(case: Instance) -> Array:
    """Checks that eta* and all policies of its Pi are safe whenever any policy is.

    Args:
        case: an instance.

    Returns:
        () the violation.
    """
    cmdp = case.cmdp
    star = exact.least_threat(cmdp)
    others = [exact.threat(cmdp, policy).state for policy in (case.eta, case.other)]
    c = jnp.maximum(_danger(case, star), _bound(case, _danger(case, star)))
    x = thresholds.corollary_2(cmdp, star.policy, c)
    reached = secure.worst(cmdp, secure.secure(star.action, x).admissible)
    beaten = jnp.max(star.state - jnp.minimum(*others))
    return jnp.maximum(beaten, jnp.maximum(_danger(case, reached) - c, -x))


def certificate(case: Instance) -> Array:
    """Checks the certificate's bound at every state, and its x, for U above or below the threat.

    A Bellman backup in insecure states must add no excess.

    Args:
        case: an instance.

    Returns:
        () the violation.
    """
    cmdp, x = case.cmdp, case.x
    found = exact.threat(cmdp, case.eta).action
    broken = []
    for upper in (found, found + 0.3 * case.noise, found * case.noise, case.noise):
        proved = thresholds.certificate(cmdp, upper, x)
        closer = looked_ahead(cmdp, upper, x)
        broken.append(jnp.max(thresholds.certificate(cmdp, closer, x).excess - proved.excess))
        reached = secure.worst(cmdp, secure.secure(upper, x).admissible)
        c = _bound(case, cmdp.start @ proved.least[0]) + _steps(cmdp) * proved.excess.max()
        fixed = thresholds.certified(cmdp, upper, c)
        inside = secure.worst(cmdp, secure.secure(upper, fixed).admissible)
        over = jnp.where(fixed >= 0, _danger(case, inside) - c, 0.0)
        broken += [jnp.max(reached.state - proved.state), over]
    return jnp.max(jnp.stack(broken))


def looked_ahead(cmdp: FiniteCMDP, upper: Array, x: Array | float) -> Array:
    """Returns U, replaced by the lesser of it and its backup where no action of it is at most x.

    Args:
        cmdp: the CMDP.
        upper: (H, S, A) U.
        x: () or (H,) thresholds.

    Returns:
        (H, S, A).
    """
    secure_at = secure.secure(upper, x).secure[..., None]
    lesser = jnp.minimum(upper, thresholds.backup(cmdp, upper))
    return jnp.where(secure_at, upper, lesser)


def advantage(case: Instance) -> Array:
    """Checks that the sets {a : T - D <= y} keep D^pi <= D^eta + y sum beta^k.

    Args:
        case: an instance; its x is y.

    Returns:
        () the violation.
    """
    cmdp, y = case.cmdp, case.x
    found = exact.threat(cmdp, case.eta)
    reached = secure.worst(cmdp, secure.secure_by_advantage(found, y).admissible)
    each = jnp.broadcast_to(y[:, None, None], cmdp.shape)
    room = exact.evaluate(cmdp, each, cmdp.beta, case.eta).state  # sum beta^{k-t} y_k
    return jnp.max(reached.state - found.state - room)


def evaluated(case: Instance) -> Array:
    """Checks that the evaluated x keeps c at its most dangerous policy, and no greater x does.

    Args:
        case: an instance.

    Returns:
        () the violation.
    """
    cmdp = case.cmdp
    found = exact.threat(cmdp, case.eta).action
    safest = _danger(case, exact.threat(cmdp, exact.greedy(found)))
    c = safest + case.share * jnp.maximum(0.2, safest)
    x = thresholds.evaluated(cmdp, found, c)
    beyond = jnp.min(jnp.where(found > x, found, jnp.inf))

    def danger(x: Array) -> Array:
        return _danger(case, secure.worst(cmdp, secure.secure(found, x).admissible))

    proved = thresholds.corollary_2(cmdp, case.eta, c)
    behind = jnp.max(jnp.where(found <= proved - 1e-9, found, -jnp.inf)) - x
    early = jnp.where(jnp.isfinite(beyond) & (danger(beyond) <= c - 1e-9), 1.0, 0.0)
    return jnp.max(jnp.stack([danger(x) - c, early, behind]))


def account(case: Instance) -> Array:
    """Checks that the danger of a policy is m_0 + E sum beta^t (V_t - m_t), for any functions m.

    Args:
        case: an instance.

    Returns:
        () the difference.
    """
    cmdp = case.cmdp
    found = exact.threat(cmdp, case.eta)
    broken = []
    for policy in (case.eta, case.other):
        danger = _danger(case, exact.threat(cmdp, policy))
        for least in (3 * case.noise[..., 0], found.action.min(axis=-1), -found.state):
            broken.append(jnp.abs(budgets.accounted(cmdp, least, policy) - danger))
    return jnp.max(jnp.stack(broken))


def _promised(case: Instance, found: budgets.Costs) -> tuple[Array, Array]:
    """Returns a budget of the start, often one that an action just fits, and c, () each."""
    fitting = found.excess.ravel()
    index = (case.share * 64 * fitting.size).astype(int) % fitting.size
    budget = jnp.where(case.share < 1, fitting[index], case.x[0])
    return budget, case.cmdp.start @ found.least[0] + budget


def budget(case: Instance) -> Array:
    """Checks that no policy that keeps to its budget has more danger than c, and the errors of U.

    Without refunds that is c + E sum beta^t e_t, with refunds c plus the expected overspend. U is a
    threat, one above or below it, or anything.

    Args:
        case: an instance with a finite horizon.

    Returns:
        () the violation.
    """
    cmdp = case.cmdp
    threats = exact.threat(cmdp, case.eta).action
    uppers = (threats, threats + 0.3 * case.noise, threats * case.noise, case.noise)
    upper = jnp.stack(uppers)[(case.share * 1000).astype(int) % 4]
    found = budgets.costs(cmdp, upper)
    start, c = _promised(case, found)

    def errors(t: int, _: Array) -> Array:
        return found.error[t][None]

    def overspent(t: int, held: Array) -> Array:
        return jnp.maximum(found.cost[t][None] - held[:, None, None], 0)

    without = _worst_within(cmdp, found.excess, found.excess, errors, start)
    refunded = _worst_within(cmdp, found.excess, found.cost, overspent, start)
    return jnp.maximum(without, refunded) - c


def _worst_within(
    cmdp: FiniteCMDP, excess: Array, cost: Array, toll: Callable[[int, Array], Array], start: Array
) -> Array:
    """Returns the greatest E sum (beta^t d - toll) of all policies that keep to a budget, ().

    It is exact: by recursion over all budgets that can be left after any states and actions.

    Args:
        cmdp: the CMDP.
        excess: (H, S, A) what actions need.
        cost: (H, S, A) what they are charged.
        toll: maps a step and budgets (N,) to tolls (N, S, A), or (1, S, A).
        start: () the first budget.
    """
    horizon, states, actions = cmdp.shape
    fitting = jax.vmap(jax.vmap(budgets.budget_actions, in_axes=(0, None)), in_axes=(None, 0))
    held = [start[None]]
    for t in range(horizon - 1):
        held.append(budgets.spend(held[t][:, None, None], cost[t][None]).ravel())
    ahead = jnp.zeros((len(held[-1]), states, actions, states))
    for t in reversed(range(horizon)):
        gain = cmdp.beta**t * cmdp.danger[None] - toll(t, held[t])
        action = gain + jnp.einsum("saz,nsaz->nsa", cmdp.transition, ahead)
        state = jnp.max(jnp.where(fitting(excess[t], held[t]), action, -jnp.inf), axis=-1)
        ahead = state.reshape(-1, states, actions, states) if t else state
    return cmdp.start @ ahead[0]


def budget_in_levels(case: Instance) -> Array:
    """Checks that no policy has more danger than c if budgets are counted in a few whole levels.

    Args:
        case: an instance with a finite horizon.

    Returns:
        () the violation.
    """
    cmdp = case.cmdp
    upper = exact.threat(cmdp, case.eta).action
    _, c = _promised(case, budgets.costs(cmdp, upper))
    broken = []
    for refund in (False, True):
        rule = budgets.budget_rule(cmdp, upper, c, refund=refund, levels=6)
        broken.append(budgets.at_start(cmdp, rule, budgets.worst(cmdp, rule)) - c)
    return jnp.maximum(*broken)


CHECKS: dict[str, Callable[[Instance], Array]] = {
    "theorem 1": theorem_1,
    "theorem 2": theorem_2,
    "corollary 1": corollary_1,
    "corollary 2": corollary_2,
    "corollary 3": corollary_3,
    "certificate": certificate,
    "advantage": advantage,
    "evaluated": evaluated,
    "account": account,
    "budget": budget,
    "budget in levels": budget_in_levels,
}

FINITE = ("theorem 1", "theorem 2", "budget", "budget in levels")  # counted step by step


def draw_factored(
    key: Array, states: int, actions: int, hazards: int, horizon: int | None
) -> tuple[factored.Factored, Array]:
    """Draws a factored model and a baseline policy eta^(o).

    Args:
        key: random key.
        states: number of states of the body, and of each hazard.
        actions: number of actions.
        hazards: number of hazards.
        horizon: number of steps, or None for the infinite horizon.

    Returns:
        The model, and the policy (H, So, A).
    """
    keys = iter(jax.random.split(key, 5 + 3 * hazards))

    def simplex(*shape: int) -> Array:
        return jax.random.dirichlet(next(keys), jnp.full(shape[-1], 0.5), shape[:-1])

    beta = jax.random.choice(next(keys), jnp.asarray(BETAS))
    model = factored.Factored(
        body=simplex(states, actions, states),
        reward=jax.random.normal(next(keys), (states, actions)),
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


def theorem_3(model: factored.Factored, etas: Array, x: Array) -> Array:
    """Checks T^eta <= sum_n T^{eta,n}, and that Algorithm 2's policies keep c.

    The sum must fulfil the certificate without excess; so must the least sum of several plans, also
    after a look-ahead by one step.

    Args:
        model: the body and its hazards.
        etas: (2, H, So, A) two baseline policies.
        x: () threshold, from which c is made.

    Returns:
        () the violation, as a fraction of the greatest danger that an episode can have.
    """
    cmdp = factored.joint(model)
    totals, broken = [], []
    for eta in etas:
        whole = exact.threat(cmdp, factored.lifted(model, eta)).action
        totals.append(factored.summed(factored.sub_threats(model, eta)))
        broken.append(jnp.max(whole - totals[-1]))
    least = jnp.minimum(*totals)
    for upper in (totals[0], least, looked_ahead(cmdp, least, x)):
        excess = thresholds.certificate(cmdp, upper, x).excess
        c = cmdp.start @ upper.min(axis=-1)[0] + x * _steps(cmdp)
        allowed = secure.secure(upper, thresholds.certified(cmdp, upper, c)).admissible
        worst = exact.expected(cmdp, secure.worst(cmdp, allowed))
        broken += [jnp.max(excess), worst - c]
    return jnp.max(jnp.stack(broken)) / thresholds.effective_horizon(model.beta, model.horizon)


def violations(key: Array, states: int, actions: int, horizon: int | None) -> dict[str, Array]:
    """Returns the violation of each check on one random instance.

    Violations are fractions of the greatest danger that an episode can have, so that rounding
    errors are alike for all instances.

    Args:
        key: random key.
        states: number of states.
        actions: number of actions.
        horizon: number of steps, or None for the infinite horizon.

    Returns:
        The violations () by the name of the check.
    """
    case = draw(key, states, actions, horizon)
    greatest = thresholds.effective_horizon(case.cmdp.beta, horizon)
    checks = [name for name in CHECKS if horizon is not None or name not in FINITE]
    return {name: CHECKS[name](case) / greatest for name in checks}


def violations_of_theorem_3(
    key: Array, states: int, actions: int, hazards: int, horizon: int | None
) -> dict[str, Array]:
    """Returns the violation of Theorem 3 on one random factored model.

    Args:
        key: random key.
        states: number of states of the body, and of each hazard.
        actions: number of actions.
        hazards: number of hazards.
        horizon: number of steps, or None for the infinite horizon.

    Returns:
        The violation () by the name of the check, as a fraction of the greatest danger that an
        episode can have.
    """
    model_key, other_key, x_key = jax.random.split(key, 3)
    model, eta = draw_factored(model_key, states, actions, hazards, horizon)
    other = jax.random.dirichlet(other_key, jnp.ones(actions), eta.shape[:-1])
    x = jax.random.uniform(x_key, maxval=1.0)
    return {"theorem 3": theorem_3(model, jnp.stack([eta, other]), x)}
