"""Calibration of sums of threats, at every level at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rp_jax.threat.correction import LEVELS, SumCorrection, calibrated_sum, correction_of


def drawn(rng, count, low=0.3):
    """States of three actions; the model says `low` to 1 times what is true, by chance."""
    true = 10 ** rng.uniform(-4, 0, (count, 3))
    return true * rng.uniform(low, 1.0, (count, 1)), true


def missed(correction, said, true, level):
    """(n,) of the states with an action above a level, which have one called at most the level."""
    called = np.asarray(correction(jnp.asarray(said)))
    dangerous = true > level
    return (dangerous & (called <= level)).any(axis=1)[dangerous.any(axis=1)]


@pytest.mark.parametrize("rate", [0.02, 0.2])
def test_the_rate_is_kept_at_all_levels_at_once_as_often_as_is_said(rate):
    """Over repeated draws of 400 states, counted on many others."""
    rng, kept = np.random.default_rng(0), []
    said, true = drawn(rng, 20_000)
    for _ in range(40):
        correction, statements = calibrated_sum(*drawn(rng, 400), rate, 0.9)
        rates = [s.rate for s in statements]
        shares = [missed(correction, said, true, level).mean() for level in LEVELS]
        assert [s.level for s in statements] == list(LEVELS)
        kept.append(all(a <= max(b, rate) for a, b in zip(shares, rates, strict=True)))
    assert np.mean(kept) >= 0.85
    uncorrected = SumCorrection(jnp.asarray([1e-7, 1.0]), jnp.asarray([1e-7, 1.0]))
    assert missed(uncorrected, said, true, 0.1).mean() > rate


def test_threats_are_raised_in_the_same_order_and_never_lowered():
    correction, _ = calibrated_sum(*drawn(np.random.default_rng(1), 500), 0.05)
    threat = jnp.concatenate([jnp.zeros(1), jnp.logspace(-9, 0.4, 400)])
    raised = np.asarray(jax.jit(lambda c, t: c(t))(correction, threat))
    assert (raised >= np.asarray(threat)).all()
    assert (np.diff(raised) >= 0).all()
    assert (np.diff(raised)[90:] > 0).all()
    assert raised[0] == 0
    np.testing.assert_array_equal(raised[np.asarray(threat) >= 1], threat[threat >= 1])
    assert (raised > 1.2 * np.asarray(threat))[200:350].mean() > 0.5


def test_what_is_never_too_low_stays_as_it_is():
    said, true = drawn(np.random.default_rng(2), 800, low=1.0)
    correction, statements = calibrated_sum(1.001 * said, true, 0.05)
    threat = jnp.logspace(-3, -0.31, 50)
    np.testing.assert_allclose(correction(threat), threat, rtol=3e-3)
    assert all(s.missed == 0 for s in statements)


def test_a_statement_by_hand():
    """Of 1,000 dangerous states 100 are called .01 and 900 .09, where .1 is true."""
    said = np.full((1000, 1), 0.09)
    said[:100] = 0.01
    true = np.full((1000, 1), 0.11)
    for rate, limit in ((0.2, 0.09), (0.05, 0.01)):  # one in ten may be missed, or may not
        correction, statements = calibrated_sum(said, true, rate)
        at = LEVELS.index(0.1)
        assert correction.said[at] == pytest.approx(0.999 * limit, rel=1e-5)
        assert float(correction(jnp.asarray(limit))) > 0.1
        assert statements[at].states == 1000
        assert statements[at].missed == (100 if rate == 0.2 else 0)
        assert statements[at].missed / 1000 <= statements[at].rate <= rate
    assert len(statements) == at + 1  # nothing was above the levels after it


def test_too_few_states_say_what_they_show():
    """Ten dangerous states without a miss show 41 % at the level of each of nine statements."""
    said, true = np.full((10, 2), 0.001), np.full((10, 2), 0.3)
    correction, statements = calibrated_sum(said, true, 0.01)
    assert statements[0].rate == pytest.approx(1 - (0.05 / len(LEVELS)) ** 0.1)
    assert float(correction(jnp.asarray(0.001))) > 0.2


def test_a_correction_comes_back_from_its_points():
    correction, _ = calibrated_sum(*drawn(np.random.default_rng(3), 300), 0.05)
    again = correction_of(correction.points)
    np.testing.assert_array_equal(again.said, correction.said)
    np.testing.assert_array_equal(again.level, correction.level)
    assert correction_of(None) is None


@pytest.mark.parametrize(
    ("rate", "confidence", "words"),
    [(0.0, 0.9, "^rate is 0.0"), (1.1, 0.9, "^rate is 1.1"), (0.1, 1.0, "^confidence is 1.0")],
)
def test_rates_out_of_range_are_refused(rate, confidence, words):
    with pytest.raises(ValueError, match=words):
        calibrated_sum(np.ones((3, 1)), np.ones((3, 1)), rate, confidence)
