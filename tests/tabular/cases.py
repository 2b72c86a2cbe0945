"""Small CMDPs with known answers."""

import functools

import jax
import numpy as np

from rp_jax.tabular import cmdp

S, U, SAFE, W1, W2 = range(5)  # states of the counterexample to T_0 with a stationary greedy


def counterexample_1():
    """T_0 as the threat of all times admits at s what endangers at u.

    s: a costs .01 and leads to u, b leads to safety; u: a1 costs 1 and leads to safety, a2 is
    free and leads to w1, then w2, which costs 1.0001. Within three steps a2 is free from u at
    t = 1, and T_0(u, a2) is not.
    """
    kernel, danger = np.zeros((5, 2, 5)), np.zeros((5, 2))
    kernel[S, 0, U] = kernel[S, 1, SAFE] = kernel[U, 0, SAFE] = kernel[U, 1, W1] = 1
    kernel[SAFE, :, SAFE] = kernel[W1, :, W2] = kernel[W2, :, SAFE] = 1
    danger[S, 0], danger[U, 0], danger[W2, :] = 0.01, 1.0, 1.0001
    model = cmdp.make(kernel, np.zeros((5, 2)), danger, S, gamma=1.0, beta=1.0, horizon=3)
    eta = np.zeros((5, 2))
    eta[:, 0] = 1
    eta[U] = [0, 1]
    return model, eta


def counterexample_2():
    """Least danger .8 stationary and deterministic, .775 stationary, .4 time-indexed."""
    kernel, danger = np.zeros((2, 2, 2)), np.zeros((2, 2))
    kernel[0, 0, 0] = kernel[0, 1, 1] = kernel[1, :, 1] = 1
    danger[0, 0], danger[1] = 0.4, 1.0
    return cmdp.make(kernel, np.zeros((2, 2)), danger, 0, gamma=1.0, beta=1.0, horizon=2)


def random_cmdp(seed, states=4, actions=3, *, horizon=4, gamma=0.9, beta=0.95, absorbing=True):
    """Dense random transitions, rewards of either sign, some danger."""
    rng = np.random.default_rng(seed)
    kernel = rng.dirichlet(np.full(states, 0.5), (states, actions))
    if absorbing:
        kernel[-1] = np.eye(states)[-1]
    return cmdp.make(
        kernel,
        rng.normal(size=(states, actions)),
        rng.uniform(size=(states, actions)) * (rng.uniform(size=(states, actions)) < 0.5),
        rng.dirichlet(np.ones(states)),
        gamma=gamma,
        beta=beta,
        horizon=horizon,
    )


def random_policy(seed, shape):
    return np.random.default_rng(seed).dirichlet(np.ones(shape[-1]), shape[:-1])


def jitted(function, static=()):
    """Compiled once for all tests that ask."""
    return _jitted(function, static)


@functools.cache
def _jitted(function, static):
    return jax.jit(function, static_argnums=static)
