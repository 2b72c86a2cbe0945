import functools

import jax
import numpy as np
import pytest
from cases import random_cmdp

from rp_jax.tabular import exact, qlearning, secure

STEPS = 150_000


@functools.cache
def learned(horizon, seeds=3):
    cmdp = random_cmdp(0, states=3, actions=3, horizon=horizon, gamma=0.6, beta=0.6)
    cmdp = cmdp.replace(reward=cmdp.reward - 2)  # so that what is never tried looks best
    found = exact.threat(cmdp, exact.uniform(cmdp)).action
    allowed = secure.secure(found, float(np.quantile(found, 0.45)))
    learn = jax.vmap(qlearning.learn, in_axes=(0, None, None, None))
    keys = jax.random.split(jax.random.key(1), seeds)
    states = jax.jit(learn, static_argnums=3)(keys, cmdp, allowed.admissible, STEPS)
    return cmdp, allowed, states


@pytest.mark.parametrize("horizon", [None, 3])
def test_q_learning_arrives_where_value_iteration_does(horizon):
    cmdp, allowed, states = learned(horizon)
    assert 0 < int(allowed.secure.sum()) < allowed.secure.size
    expected = np.asarray(secure.plan(cmdp, allowed.admissible).action)
    for values in np.asarray(states.values):
        np.testing.assert_allclose(
            values[np.asarray(allowed.admissible)],
            expected[np.asarray(allowed.admissible)],
            atol=0.06,
        )


@pytest.mark.parametrize("horizon", [None, 3])
def test_nothing_inadmissible_is_ever_tried(horizon):
    _, allowed, states = learned(horizon)
    tried = np.asarray(states.visits)
    outside = ~np.asarray(allowed.admissible)
    assert outside.any()
    assert (tried[:, outside] == 0).all()
    assert (tried[:, ~outside] > 1000).all()
    assert (tried.sum(axis=(1, 2, 3)) == STEPS).all()
    assert not np.array_equal(tried[0], tried[1])


def test_settings_out_of_range_are_named():
    cmdp = random_cmdp(0)
    mask = np.ones(cmdp.shape, bool)
    with pytest.raises(ValueError, match="steps is 0; it must be"):
        qlearning.learn(jax.random.key(0), cmdp, mask, 0)
    with pytest.raises(ValueError, match=r"omega is 0\.5; it must be"):
        qlearning.learn(jax.random.key(0), cmdp, mask, 10, omega=0.5)
