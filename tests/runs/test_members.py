"""Agents side by side: their names, their thresholds, and in what order they come."""

import jax.numpy as jnp
import numpy as np
import probe
import pytest

from rp_jax.dynamics import Plans
from rp_jax.envs import jam
from rp_jax.runs.agents import Member, method_name, side_by_side, with_member
from rp_jax.runs.plan import make_pmdp, members_of

INF = float("inf")


def test_methods_are_named_by_what_sets_them_apart():
    params = probe.make_params()
    held, free = (probe.make_pmdp(probe, params, x) for x in (0.5, INF))
    assert method_name(held, Member(0, 0.001, 0.0)) == "RP (x=0.001)"
    assert method_name(held, Member(0, 0.001, 5.0)) == "RP (x=0.001, 5)"
    assert method_name(held, Member(0, INF, 50.0)) == "DQN (penalty 50)"
    assert method_name(free, Member(0, 0.001, 50.0)) == "DQN (penalty 50)"
    planned = jam.make_params(1, baseline="plans")
    assert isinstance(planned.body.baseline, Plans)
    found = make_pmdp(jam, planned, None).replace(shielded=True)
    assert method_name(found, Member(0, 0.01, 0.0)) == "RP, plans (x=0.01)"


@pytest.mark.parametrize("x", [0.1, 0.001, 0.9, 0.0, INF])
def test_the_threshold_is_nowhere_above_what_was_asked_for(x):
    pmdp, member = make_pmdp(probe, probe.make_params(), None, x=x), Member(0, x, 0.0)
    everywhere = (pmdp.x, side_by_side(pmdp, [member])[0].x[0], with_member(pmdp, member).x)
    for found in everywhere:
        assert found.dtype == np.float32
        assert float(found) <= x
        assert float(np.nextafter(np.asarray(found), np.float32(np.inf))) > x or x == INF


def test_thresholds_and_penalties_are_paired_and_each_has_all_seeds():
    assert members_of((0.1, 0.2), 0.0, 2) == (
        *(Member(0, 0.1, 0.0), Member(1, 0.1, 0.0)),
        *(Member(0, 0.2, 0.0), Member(1, 0.2, 0.0)),
    )
    assert members_of(0.1, (0.0, 20.0), [7]) == (Member(7, 0.1, 0.0), Member(7, 0.1, 20.0))
    assert members_of((0.1, 0.2), (1.0, 2.0), 1) == (Member(0, 0.1, 1.0), Member(0, 0.2, 2.0))
    several, axes = side_by_side(probe.make_pmdp(probe, probe.make_params()), members_of(1, 2, 3))
    assert (several.x.shape, several.penalty.shape) == ((3,), (3,))
    assert (axes.x, axes.penalty, axes.params, axes.insecure_penalty) == (0, 0, None, None)
    np.testing.assert_array_equal(several.penalty, jnp.full(3, 2.0))


@pytest.mark.parametrize(
    ("x", "penalty", "seeds", "message"),
    [
        ((0.1, 0.2, 0.3), (1.0, 2.0), 1, "learning_penalty has 2 values; it must have 1, or 3"),
        ((), 0.0, 1, "x, learning_penalty and seeds must each have at least one value"),
        (0.1, 0.0, [], "x, learning_penalty and seeds must each"),
        (-0.1, 0.0, 1, "x is -0.1"),
        (0.1, INF, 1, "learning_penalty is inf"),
        (0.1, 0.0, 0, "seeds is 0"),
        (0.1, 0.0, [-1], "seeds is -1"),
    ],
)
def test_bad_choices_are_named(x, penalty, seeds, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        members_of(x, penalty, seeds)
