"""A certificate settles before it plays, counts what it plays, and never more than that."""

import jax
import jax.numpy as jnp
import numpy as np
import probe
import pytest
from tiny import programs_of_a_moment  # noqa: F401

from rp_jax import evaluation, statistics
from rp_jax.planning.loop import LoopConfig
from rp_jax.runs import certify as module
from rp_jax.runs.certify import certify
from rp_jax.runs.plan import plan
from rp_jax.streams import Stream, key_of

KEY = jax.random.key(0)
TINY = LoopConfig(steps=64, num_envs=8, batch=8, n_step=1, replay=64, replay_start=8)


@pytest.fixture(scope="module")
def agents():
    return plan(KEY, probe, probe.make_params(), config=TINY)


@pytest.fixture
def playing(monkeypatch):
    """Replaces what is played by rows in which each episode crashes with a probability."""

    def crash_with(probability, planned=None):
        def play(key, pmdp, policy, size):
            zero = jnp.zeros(size)
            danger = jax.random.bernoulli(key, probability, (size,)).astype(float)
            no = jnp.zeros(size, int)
            return evaluation.Episodes(zero, danger, no > 0, no + 1, no, no, zero, {}, no, no)

        monkeypatch.setattr(module.evaluation, "play_round", play)
        monkeypatch.setattr(module, "ROUND", 100)
        if planned is not None:
            monkeypatch.setattr(statistics, "plan_test", lambda *_: planned)

    return crash_with


def crashes_of(probability, rounds, size=100):
    """By round, from the keys that the certificate has to use."""
    own = key_of(KEY, Stream.CERTIFICATE)
    draw = lambda i: jax.random.bernoulli(jax.random.fold_in(own, i), probability, (size,))  # noqa: E731
    return [np.asarray(draw(i)) for i in range(rounds)]


def test_each_round_has_episodes_of_its_own_and_the_last_is_cut(agents, playing):
    playing(0.1, planned=(350, 60))
    found = certify(KEY, agents, c=0.3)
    whole = np.concatenate(crashes_of(0.1, 4))[:350]
    assert (found.episodes, found.crashes) == (350, int(whole.sum()))
    assert found.shown
    assert found.upper_bound == statistics.upper_bound(found.crashes, 350, 0.99)
    assert len({tuple(rows) for rows in crashes_of(0.1, 4)}) == 4


@pytest.mark.parametrize("spare", [0, 1])
def test_as_many_crashes_as_were_planned_are_allowed_and_no_more(spare, agents, playing):
    count = int(np.concatenate(crashes_of(0.2, 3)).sum())
    playing(0.2, planned=(300, count - 1 + spare))
    found = certify(KEY, agents, c=0.5)
    assert found.crashes == count
    assert found.shown == (spare == 1)
    assert (found.upper_bound is None) == (spare == 0)
    assert ("NOT SHOWN" in str(found)) == (spare == 0)


def test_it_ends_with_the_round_in_which_there_are_too_many(agents, playing):
    playing(0.5, planned=(1000, 60))
    told = []
    found = certify(KEY, agents, c=0.5, on_progress=lambda *facts: told.append(facts[1:3]))
    first, second = (int(rows.sum()) for rows in crashes_of(0.5, 2))
    assert first <= 60 < first + second
    assert (found.episodes, found.crashes) == (200, first + second)
    assert told == [(1, 10), (2, 10)]
    assert not found.shown


def test_the_plan_is_told_before_anything_is_played(agents, monkeypatch):
    def stop(*_):
        raise RuntimeError("played")

    monkeypatch.setattr(module.evaluation, "play_round", stop)
    told = []
    with pytest.raises(RuntimeError, match="played"):
        certify(KEY, agents, c=0.01, confidence=0.95, on_plan=lambda *plan: told.append(plan))
    assert told == [statistics.plan_test(0.01, 0.95, 0.005, 0.9)]
