import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from rp_jax.shield import (
    correct,
    greedy_eta,
    masked_argmax,
    masked_sample,
    narrowed,
    rounded_down,
    rounded_up,
    shield,
    threat_array,
    threshold_array,
)

A = 5
# Few distinct values, so that ties and equality with the threshold come up.
some = st.sampled_from([0.0, 0.01, 0.1, 0.5, 1.0, 2.5])
finite = hnp.arrays(np.float32, A, elements=some.map(np.float32))
threats = hnp.arrays(np.float32, A, elements=st.one_of(some, st.just(np.nan)).map(np.float32))
masks = hnp.arrays(bool, A)
thresholds = st.one_of(some, st.just(np.inf), st.just(-1.0)).map(np.float32)
protect = jax.jit(shield)
SUBSETS = np.asarray([[bool(i >> a & 1) for a in range(A)] for i in range(1, 2**A)])


@given(threats, thresholds)
def test_the_admissible_set_is_never_empty(threat, x):
    assert protect(threat, x).admissible.any()


@given(threats, thresholds)
def test_a_secure_state_admits_exactly_the_actions_within_the_threshold(threat, x):
    admissible, secure = protect(threat, x)
    within = threat <= x
    assert secure == within.any()
    if secure:
        np.testing.assert_array_equal(admissible, within)


@given(threats, thresholds)
def test_an_insecure_state_admits_the_least_threatening_action_alone(threat, x):
    admissible, secure = protect(threat, x)
    assume(not secure)
    best = 0 if np.isnan(threat).all() else np.nanargmin(threat)
    np.testing.assert_array_equal(admissible, np.arange(A) == best)
    assert greedy_eta(threat) == best


@given(finite)
def test_an_infinite_threshold_admits_every_action(threat):
    admissible, secure = protect(threat, np.inf)
    assert admissible.all()
    assert secure


@given(threats, thresholds)
def test_a_threat_that_is_nan_is_never_admissible_unless_all_are(threat, x):
    assume(not np.isnan(threat).all())
    assert not (np.asarray(protect(threat, x).admissible) & np.isnan(threat)).any()


@given(thresholds)
def test_of_threats_that_are_all_nan_the_first_action_remains(x):
    admissible, secure = protect(np.full(A, np.nan, np.float32), x)
    np.testing.assert_array_equal(admissible, np.arange(A) == 0)
    assert not secure


def test_an_action_exactly_at_the_threshold_is_admissible():
    at = jnp.float32(0.01)
    above = jnp.nextafter(at, jnp.float32(1))
    admissible = shield(jnp.stack([above, at, jnp.nextafter(at, jnp.float32(0))]), at).admissible
    np.testing.assert_array_equal(admissible, [False, True, True])


def test_of_equally_small_threats_the_first_is_greedy():
    threat = jnp.asarray([0.7, 0.3, 0.5, 0.3])
    assert greedy_eta(threat) == 1
    np.testing.assert_array_equal(shield(threat, 0.1).admissible, [False, True, False, False])


@given(finite, some, some)
def test_a_larger_threshold_never_admits_less_in_a_secure_state(threat, x, y):
    low, high = sorted((np.float32(x), np.float32(y)))
    small, large = protect(threat, low), protect(threat, high)
    assume(small.secure)
    assert (np.asarray(large.admissible) | ~np.asarray(small.admissible)).all()


def test_the_threshold_can_be_swept_by_vmap():
    threat = jnp.asarray([0.0, 0.2, 0.4])
    admissible = jax.vmap(shield, (None, 0))(threat, jnp.asarray([0.1, 0.3, jnp.inf])).admissible
    np.testing.assert_array_equal(admissible, [[1, 0, 0], [1, 1, 0], [1, 1, 1]])


@given(finite, masks)
def test_the_greatest_admissible_value_lies_inside_the_mask(values, mask):
    assume(mask.any())
    best = int(masked_argmax(values, mask))
    assert mask[best]
    assert best == np.flatnonzero(mask & (values == values[mask].max()))[0]


def test_the_mask_hides_even_the_greatest_value():
    values, mask = jnp.asarray([9.0, -3.0, -2.0]), jnp.asarray([False, True, True])
    assert masked_argmax(values, mask) == 2


wild = st.one_of(some, st.sampled_from([np.nan, np.inf, -np.inf, -1.0])).map(np.float32)
correct_jit = jax.jit(correct)
PLACES = np.asarray([[0, 0], [1, 0], [0, 1], [-1, 0], [0.5, 0.5]], np.float32)


@given(threats, hnp.arrays(np.float32, A, elements=wild), thresholds)
def test_of_scores_the_best_admissible_one_is_taken_whatever_they_are(threat, scores, x):
    found, mask = correct_jit(threat, scores, x), np.asarray(protect(threat, x).admissible)
    assert mask[found.action]
    rank = np.nan_to_num(scores, nan=np.finfo(np.float32).min)
    assert rank[found.action] == rank[mask].max()
    assert bool(found.intervened) == (int(found.action) != int(np.argmax(rank)))
    assert bool(found.secure) == bool((threat <= x).any())


@given(threats, st.integers(0, A - 1), thresholds)
def test_an_action_passes_if_admissible_and_gives_way_to_the_least_threatening(threat, wish, x):
    found, mask = correct_jit(threat, wish, x), np.asarray(protect(threat, x).admissible)
    assert int(found.action) == (wish if mask[wish] else int(greedy_eta(threat)))
    assert bool(found.intervened) == (not mask[wish])


@given(threats, hnp.arrays(np.float32, 2, elements=st.floats(-2, 2, width=32)), thresholds)
def test_a_continuous_action_gives_way_to_the_nearest_admissible_row(threat, wish, x):
    found, mask = correct_jit(threat, wish, x, PLACES), np.asarray(protect(threat, x).admissible)
    distance = np.linalg.norm(PLACES - wish, axis=1)
    assert mask[found.action]
    assert distance[found.action] <= distance[mask].min() + 1e-6
    assert bool(found.intervened) <= (distance[found.action] >= distance.min())


@pytest.mark.parametrize(
    ("wish", "table", "allowed"),
    [
        (jnp.zeros(A - 1), None, r"an integer, or floats of shape \(5,\)"),
        (jnp.asarray(0.5), None, r"an integer, or floats of shape \(5,\)"),
        (jnp.zeros(A, int), None, r"an integer, or floats of shape \(5,\)"),
        (jnp.asarray(True), None, r"an integer, or floats of shape \(5,\)"),
        (jnp.asarray(1), PLACES, r"floats of shape \(2,\)"),
        (jnp.zeros(3), PLACES, r"floats of shape \(2,\)"),
    ],
)
def test_a_wish_of_another_shape_or_type_is_refused(wish, table, allowed):
    with pytest.raises(ValueError, match=rf"^action is .*; it must be {allowed}$"):
        correct(jnp.zeros(A), wish, 0.1, table)


def test_samples_are_uniform_over_every_mask():
    keys = jax.random.split(jax.random.key(0), 3000)
    draw = jax.jit(jax.vmap(jax.vmap(masked_sample, (0, None)), (None, 0)))
    drawn = np.asarray(draw(keys, jnp.asarray(SUBSETS)))
    for row, mask in zip(drawn, SUBSETS, strict=True):
        counts = np.bincount(row, minlength=A)
        assert counts[~mask].sum() == 0
        assert mask.sum() == 1 or stats.chisquare(counts[mask]).pvalue > 1e-4


def test_a_mask_of_one_action_leaves_no_choice():
    for action in range(A):
        assert masked_sample(jax.random.key(action), jnp.arange(A) == action) == action


@pytest.mark.parametrize(
    "use",
    [
        lambda: shield(jnp.zeros((2, A)), 0.1),
        lambda: shield(jnp.zeros(A), jnp.zeros(A)),
        lambda: masked_argmax(jnp.zeros((2, A)), jnp.ones((2, A), bool)),
        lambda: masked_sample(jax.random.key(0), jnp.ones((2, A), bool)),
    ],
)
def test_batches_are_refused_since_all_is_unbatched(use):
    with pytest.raises(ValueError, match=r"; it must be an array of (1|no) axis"):
        use()


@pytest.mark.parametrize(
    ("value", "above", "below"),
    [
        (0.5, 0.5, 0.5),  # a float32 number stays
        (0.1, 0.1, 0.0999999940395355),  # the neighbours of .1 are .09999999404 and .10000000149
        (1 + 2.0**-40, 1 + 2.0**-23, 1.0),
        (-0.1, -0.0999999940395355, -0.1),
        (1e-42, 2.0**-126, 713 * 2.0**-149),  # compiled code takes subnormal numbers for 0
        (0.0, 0.0, 0.0),
        (1e39, np.inf, np.finfo(np.float32).max),
        (np.inf, np.inf, np.inf),
    ],
)
def test_threats_are_rounded_up_and_thresholds_down(value, above, below):
    for function, wanted in ((rounded_up, above), (rounded_down, below)):
        found = function(value)
        assert found.dtype == np.float32
        assert found == np.float32(wanted)
    assert float(rounded_down(value)) <= value <= float(rounded_up(value))


# As float32 numbers .001 and .002 are rounded up, .01 and .1 alternately down and up.
@pytest.mark.parametrize("x", [0.001, 0.002, 0.01, 0.1, 0.5])
def test_no_threat_above_the_given_threshold_is_admitted_by_rounding_it(x):
    near = np.float32(x)
    rows = np.asarray([np.nextafter(near, np.float32(to)) for to in (0, near, 1)], np.float32)
    within = rows.astype(float) <= x
    assert 0 < within.sum() < 3
    for given_as in (x, np.float64(x), np.asarray(x)):
        np.testing.assert_array_equal(shield(rows, given_as).admissible, within)
        constant = jax.jit(lambda threat, x=given_as: correct(threat, rows, x))  # the highest score
        assert float(rows[constant(rows).action]) <= x
    both = shield(np.stack([rows[:2], rows[1:]])[0].astype(np.float64), x)
    np.testing.assert_array_equal(both.admissible, within[:2])


@pytest.mark.parametrize("double", [False, True])
def test_threats_come_into_a_program_in_its_precision_and_not_below_themselves(double):
    threat = np.asarray(
        [0.1, 0.1 + 1e-9, 0.5, np.inf, np.nan]
    )  # the nearest float32 is .10000000149
    with jax.enable_x64(double):
        found = np.asarray(threat_array(threat))
        assert found.dtype == (np.float64 if double else np.float32)
        assert not (found < threat).any()
        np.testing.assert_array_equal(found[2:], threat[2:].astype(found.dtype))
        traced = jnp.float32(0.25)
        assert threat_array(traced) is traced
        # .01 - 2e-10 is the nearest float32 to .01; a threat of .01 is above it.
        limit = rounded_down(0.01)
        allowed = shield(np.asarray([0.01, 0.009]), jnp.asarray(limit)).admissible
        np.testing.assert_array_equal(allowed, [False, True])


def test_thresholds_keep_what_needs_no_rounding():
    traced = jnp.float32(0.001)
    assert narrowed(traced, np.float32) is traced
    assert narrowed(np.inf, np.float32) == np.inf
    assert narrowed(-np.inf, np.float32) == -np.inf
    assert narrowed(0.001, np.float64) == 0.001
    assert narrowed(0.5, np.float32) == 0.5


@pytest.mark.parametrize("double", [False, True])
def test_thresholds_come_into_a_program_in_its_precision_and_not_above_themselves(double):
    given_as = [0.001, 0.01, 0.5, np.inf]
    with jax.enable_x64(double):
        found = threshold_array(given_as)
    assert found.dtype == (np.float64 if double else np.float32)
    below = [0.001, 0.01, 0.5, np.inf] if double else [9.9999993e-4, 9.9999998e-3, 0.5, np.inf]
    np.testing.assert_array_equal(found, np.asarray(below, found.dtype))
    assert (np.asarray(found, float) <= given_as).all()
