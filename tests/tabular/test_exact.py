import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import counterexample_2, jitted, random_cmdp, random_policy

from rp_jax.tabular import exact

evaluate = jitted(exact.threat)
least = jitted(exact.least_threat)
iterate = jitted(exact.policy_iteration, static=(2,))


def by_trajectories(cmdp, policy, t, state, action):
    """Equation 3, term by term, over all continuations."""
    kernel, danger = np.asarray(cmdp.transition), np.asarray(cmdp.danger)
    horizon, states, actions = cmdp.shape
    total = danger[state, action]
    if t + 1 == horizon:
        return total
    for arrival in range(states):
        chance = kernel[state, action, arrival]
        if chance == 0:
            continue
        for then in range(actions):
            ahead = by_trajectories(cmdp, policy, t + 1, arrival, then)
            total += chance * float(cmdp.beta) * policy[t + 1, arrival, then] * ahead
    return total


@pytest.mark.parametrize("beta", [0.0, 0.7, 1.0])
def test_threats_are_expected_discounted_dangers(beta):
    cmdp = random_cmdp(0, states=3, actions=2, horizon=3, beta=beta)
    policy = random_policy(1, cmdp.shape)
    found = evaluate(cmdp, jnp.asarray(policy))
    for t, state, action in np.ndindex(cmdp.shape):
        expected = by_trajectories(cmdp, policy, t, state, action)
        assert found.action[t, state, action] == pytest.approx(expected, abs=1e-12)
    np.testing.assert_allclose(found.state, (policy * found.action).sum(-1), atol=1e-14)
    assert exact.expected(cmdp, found) == pytest.approx(cmdp.start @ found.state[0])


def test_a_stationary_policy_is_the_same_at_all_steps():
    cmdp = random_cmdp(2)
    policy = jnp.asarray(random_policy(3, cmdp.danger.shape))
    once = evaluate(cmdp, policy)
    many = evaluate(cmdp, jnp.broadcast_to(policy, cmdp.shape))
    np.testing.assert_allclose(once.action, many.action, rtol=1e-12)  # two programs


def test_returns_are_threats_of_the_reward():
    cmdp = random_cmdp(4)
    policy = jnp.asarray(random_policy(5, cmdp.danger.shape))
    swapped = cmdp.replace(danger=cmdp.reward, beta=cmdp.gamma)
    np.testing.assert_array_equal(
        jitted(exact.returns)(cmdp, policy).state, evaluate(swapped, policy).state
    )


@pytest.mark.parametrize("beta", [0.0, 0.5, 0.95])
def test_the_infinite_horizon_is_the_limit_of_long_ones(beta):
    endless = random_cmdp(6, horizon=None, beta=beta)
    long = random_cmdp(6, horizon=800, beta=beta)
    policy = jnp.asarray(random_policy(7, endless.danger.shape))
    for solve in (evaluate, lambda cmdp, _: least(cmdp)):
        found = solve(endless, policy)
        assert found.action.shape == (1, 4, 3)
        np.testing.assert_allclose(found.action[0], solve(long, policy).action[0], atol=1e-12)


def test_near_beta_1_the_infinite_horizon_is_solved_and_ends():
    cmdp = random_cmdp(8, horizon=None, beta=1 - 1e-6, absorbing=False)
    cmdp = cmdp.replace(danger=jnp.round(cmdp.danger))  # ties
    found = least(cmdp)
    backed = cmdp.danger + cmdp.beta * (cmdp.transition @ found.state[0])
    np.testing.assert_allclose(backed.min(-1), found.state[0], rtol=1e-9)


@pytest.mark.parametrize("horizon", [1, 3])
def test_the_least_threat_is_that_of_the_best_of_all_policies(horizon):
    cmdp = random_cmdp(9, states=3, actions=2, horizon=horizon)
    best = least(cmdp)
    choices = list(itertools.product(range(2), repeat=horizon * 3))
    policies = jax.nn.one_hot(np.reshape(choices, (-1, horizon, 3)), 2)
    every = jax.jit(jax.vmap(exact.threat, in_axes=(None, 0)))(cmdp, policies)
    np.testing.assert_allclose(best.state, every.state.min(axis=0), atol=1e-12)
    again = evaluate(cmdp, best.policy)
    np.testing.assert_allclose(again.state, best.state, atol=1e-12)


def test_only_time_indexed_policies_reach_the_least_threat():
    cmdp = counterexample_2()
    found = least(cmdp)
    assert exact.expected(cmdp, found) == pytest.approx(0.4)
    np.testing.assert_array_equal(found.policy[:, 0], [[1, 0], [0, 1]])
    stay = [
        float(exact.expected(cmdp, evaluate(cmdp, jnp.asarray([[p, 1 - p], [1.0, 0.0]]))))
        for p in (0.0, 1.0, 0.75)
    ]
    assert stay == pytest.approx([1.0, 0.8, 0.775])


def test_policy_iteration_never_makes_it_worse_and_arrives():
    for seed in range(10):
        cmdp = random_cmdp(seed, horizon=5)
        steps = iterate(cmdp, exact.uniform(cmdp), 6)
        assert len(steps) == 7
        np.testing.assert_allclose(steps[0], 1 / 3)
        dangers = [np.asarray(evaluate(cmdp, eta).state) for eta in steps]
        for before, after in itertools.pairwise(dangers):
            assert (after <= before + 1e-12).all()
        np.testing.assert_allclose(dangers[-1], least(cmdp).state, atol=1e-12)


def test_ties_go_to_the_first_action():
    np.testing.assert_array_equal(
        exact.greedy(jnp.asarray([[[0.5, 0.2, 0.2]], [[1.0, 1.0, 1.0]]])),
        [[[0, 1, 0]], [[1, 0, 0]]],
    )
