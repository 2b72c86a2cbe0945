import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import random_cmdp

from rp_jax.tabular import cmdp, exact

KERNEL = np.asarray([[[0.25, 0.75], [1.0, 0.0]], [[0.0, 1.0], [0.5, 0.5]]])
GOOD = {
    "transition": KERNEL,
    "reward": np.asarray([[1.0, -2.0], [0.0, 3.0]]),
    "danger": np.asarray([[0.0, 2.0], [0.5, 0.0]]),
    "start": np.asarray([0.5, 0.5]),
    "gamma": 0.9,
    "beta": 1.0,
    "horizon": 3,
}


def test_what_is_given_is_what_is_held():
    made = cmdp.make(**GOOD)
    assert made.shape == (3, 2, 2)
    for name in ("transition", "reward", "danger", "start", "gamma", "beta"):
        np.testing.assert_array_equal(getattr(made, name), GOOD[name])
        assert getattr(made, name).dtype == np.float64
    assert made.horizon == 3
    assert cmdp.make(**{**GOOD, "horizon": None, "beta": 0.9}).shape == (1, 2, 2)


def test_a_first_state_may_be_named():
    np.testing.assert_array_equal(cmdp.make(**{**GOOD, "start": 1}).start, [0.0, 1.0])


def test_signals_of_arrival_are_averaged():
    arriving = np.broadcast_to([10.0, 20.0], (2, 2, 2))
    made = cmdp.make(**{**GOOD, "reward": arriving, "danger": arriving})
    np.testing.assert_allclose(made.reward, [[17.5, 10.0], [20.0, 15.0]])
    np.testing.assert_allclose(made.danger, made.reward)


def test_rows_within_rounding_are_made_to_sum_to_one():
    made = cmdp.make(**{**GOOD, "transition": KERNEL * (1 + 5e-7)})
    np.testing.assert_allclose(made.transition.sum(-1), 1, atol=1e-15)


NEGATIVE = KERNEL.copy()
NEGATIVE[0, 0] = [1.5, -0.5]


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("transition", KERNEL[0], r"transition has shape \(2, 2\); it must be \(S, A, S\)"),
        ("transition", KERNEL[:1], "transition has shape"),
        ("transition", np.zeros((0, 2, 0)), "transition has shape"),
        ("transition", KERNEL * 1.1, r"transition\[0, 0\] sums to 1.1"),
        ("transition", NEGATIVE, "transition has the probability -0.5"),
        ("transition", KERNEL * np.nan, "transition has a value that is not finite"),
        ("transition", "no array", "transition is no array of numbers"),
        ("transition", [[1], [1, 2]], "transition is no array of numbers"),
        ("reward", np.zeros((2, 3)), r"reward has shape \(2, 3\); it must be \(2, 2\) or"),
        ("reward", np.full((2, 2), np.inf), "reward has a value that is not finite"),
        ("danger", -np.ones((2, 2)), "danger has the value -1.0; it must be at least 0"),
        ("start", [0.5, 0.6], "start sums to 1.1; it must sum to 1"),
        ("start", [1.0], r"start has shape \(1,\); it must be \(2,\)"),
        ("start", 2, "start is 2; it must be an integer, at least 0, at most 1"),
        ("gamma", 1.1, "gamma is 1.1; it must be a finite number, at least 0, at most 1"),
        ("beta", -0.1, "beta is -0.1; it must be"),
        ("beta", float("nan"), "beta is nan; it must be"),
        ("horizon", 0, "horizon is 0; it must be an integer, at least 1"),
        ("horizon", 2.5, "horizon is 2.5; it must be an integer"),
        ("horizon", None, "beta is 1.0; as float64 it must be below 1 for the infinite horizon"),
        ("reward", np.full((2, 2), 1j), "reward is no array of numbers"),
    ],
)
def test_what_is_wrong_is_named(field, value, message):
    with pytest.raises(ValueError, match=message):
        cmdp.make(**{**GOOD, field: value})


TABLE = {
    0: {0: [(0.5, 1, 2.0, False), (0.25, 1, 6.0, False), (0.25, 0, 0.0, True)]},
    1: {0: [(1.0, 1, 0.0, False)]},
}
DISCOUNTS = {"gamma": 1.0, "beta": 1.0, "horizon": 5}


def test_successors_listed_twice_are_added_up_and_ends_lead_nowhere():
    made = cmdp.from_table(TABLE, danger=[0.0, 1.0], start=0, **DISCOUNTS)
    np.testing.assert_allclose(made.transition[0, 0], [0, 0.75, 0.25])
    np.testing.assert_allclose(made.transition[2], [[0, 0, 1]])
    np.testing.assert_allclose(made.reward[:, 0], [2.5, 0, 0])
    np.testing.assert_allclose(made.danger[:, 0], [0.75, 1, 0])
    spread = cmdp.from_table(TABLE, danger=[0.0, 1.0], start=[0.5, 0.5], **DISCOUNTS)
    np.testing.assert_allclose(spread.start, [0.5, 0.5, 0])


@pytest.mark.parametrize(
    ("table", "danger", "message"),
    [
        ({**TABLE, 1: {}}, [0, 1], "table has states with other than 1 actions"),
        ({**TABLE, 1: {**TABLE[1], 1: TABLE[1][0]}}, [0, 1], "table has states with other than 1"),
        ({0: TABLE[0], 2: TABLE[1]}, [0, 1], "table is no table"),
        (None, [0, 1], "table is no table"),
        ({**TABLE, 1: {0: [(1.0, 1)]}}, [0, 1], "table is no table"),
        ({**TABLE, 1: {0: [(1.0, 1, "prize", False)]}}, [0, 1], "table is no table"),
        ({**TABLE, 1: {0: [(1.0, 0.5, 0, False)]}}, [0, 1], "next state is 0.5; it must be"),
        (
            {**TABLE, 1: {0: [(-0.5, 1, 0, False), (1.5, 1, 0, False)]}},
            [0, 1],
            r"table\[1\]\[0\]: probability is -0.5",
        ),
        (TABLE, [-1, 1], "danger has the value -1.0"),
        ({**TABLE, 1: {0: [(1.0, 7, 0, False)]}}, [0, 1], "next state is 7; it must be"),
        ({**TABLE, 1: {0: [(0.9, 1, 0, False)]}}, [0, 1], r"transition\[1, 0\] sums to 0.9"),
        (TABLE, [0], r"danger has shape \(1,\); it must be \(2,\)"),
    ],
)
def test_what_is_wrong_with_a_table_is_named(table, danger, message):
    with pytest.raises(ValueError, match=message):
        cmdp.from_table(table, danger=danger, start=0, **DISCOUNTS)


def test_cmdps_are_solved_side_by_side():
    models = [random_cmdp(seed) for seed in range(5)]
    together = jax.tree.map(lambda *leaves: jnp.stack(leaves), *models)
    found = jax.jit(jax.vmap(exact.least_threat))(together)
    for i, model in enumerate(models):
        np.testing.assert_allclose(found.state[i], exact.least_threat(model).state, rtol=1e-12)


def test_a_table_may_be_of_lists_and_its_starts_are_its_own_states():
    lists = [[TABLE[s][0]] for s in range(2)]
    made = cmdp.from_table(lists, danger=[0.0, 1.0], start=0, **DISCOUNTS)
    assert made.shape == (5, 3, 1)
    for start, message in ((2, "start is 2; it must be"), ([1.0], r"must be \(2,\)")):
        with pytest.raises(ValueError, match=message):
            cmdp.from_table(TABLE, danger=[0.0, 1.0], start=start, **DISCOUNTS)


def test_what_the_precision_cannot_hold_is_an_error():
    with jax.enable_x64(False):
        for field, value, message in (
            ("beta", 1 - 1e-9, "as float32 it must be below 1"),
            ("danger", np.full((2, 2), 1e300), "danger has a value that is not finite"),
        ):
            settings = {**GOOD, "horizon": None, "beta": 0.5, field: value}
            with pytest.raises(ValueError, match=message):
                cmdp.make(**settings)
