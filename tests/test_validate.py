import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rp_jax.validate import number, one_of, positive


def test_one_of_returns_an_allowed_value():
    assert one_of("kind", "b", ("a", "b")) == "b"


def test_one_of_names_the_field_the_value_and_all_choices():
    with pytest.raises(ValueError, match=r"^kind is 'c'; it must be one of 'a', 'b'$"):
        one_of("kind", "c", ("a", "b"))


def test_one_of_takes_any_iterable_such_as_the_keys_of_a_mapping():
    with pytest.raises(ValueError, match="'default', 'circle'"):
        one_of("track", "oval", {"default": 1, "circle": 2})


@pytest.mark.parametrize(
    ("value", "rules"),
    [
        (1, {}),
        (-2.5, {}),
        (0, {"least": 0}),
        (1, {"most": 1}),
        (1e-300, {"above": 0}),
        (3, {"integer": True}),
        (np.int64(3), {"integer": True, "least": 1}),
        (np.float32(0.5), {"least": 0}),
        (float("inf"), {"infinite": True}),
        (float("inf"), {"infinite": True, "above": 0}),
    ],
)
def test_number_returns_a_value_within_the_rules(value, rules):
    assert number("n", value, **rules) == value


@pytest.mark.parametrize(
    ("value", "rules", "allowed"),
    [
        (-1, {"least": 0}, "a finite number, at least 0"),
        (1.5, {"most": 1}, "a finite number, at most 1"),
        (0, {"above": 0}, "a finite number, above 0"),
        (2, {"above": 2, "most": 3}, "a finite number, above 2, at most 3"),
        (2.5, {"integer": True}, r"an integer, at most 2e\+09"),
        (10**10, {"integer": True}, r"an integer, at most 2e\+09"),
        (10**39, {}, "a finite number"),  # not in single precision
        (
            2.0,
            {"integer": True},
            r"an integer, at most 2e\+09",
        ),  # shapes and counts must be of an integer type
        (0, {"integer": True, "least": 1, "most": 9}, "an integer, at least 1, at most 9"),
        (float("inf"), {}, "a finite number"),
        (float("-inf"), {"infinite": True, "least": 0}, "a number, at least 0"),
        (float("nan"), {}, "a finite number"),
        (float("nan"), {"infinite": True}, "a number"),
        (True, {}, "a finite number"),
        ("3", {}, "a finite number"),
        (None, {}, "a finite number"),
        ([1], {}, "a finite number"),
    ],
)
def test_number_names_the_field_the_value_and_what_is_allowed(value, rules, allowed):
    with pytest.raises(
        ValueError, match=f"^speed is {re.escape(repr(value))}; it must be {allowed}$"
    ):
        number("speed", value, **rules)


@given(st.floats(allow_nan=True), st.floats(-10, 10), st.floats(-10, 10))
def test_number_accepts_exactly_the_finite_values_of_the_interval(value, least, most):
    good = least <= value <= most
    if good:
        assert number("n", value, least=least, most=most) == value
    else:
        with pytest.raises(ValueError, match=r"^n is"):
            number("n", value, least=least, most=most)


@pytest.mark.parametrize("value", [0, -1.0, float("inf"), float("nan"), "1"])
def test_positive_refuses_what_is_not_above_zero_and_finite(value):
    with pytest.raises(ValueError, match=r"^width is .*; it must be a finite number, above 0$"):
        positive("width", value)


def test_positive_checks_the_upper_end_and_whole_numbers():
    assert positive("n", 3, most=3, integer=True) == 3
    with pytest.raises(ValueError, match=r"^n is 4; it must be an integer, above 0, at most 3$"):
        positive("n", 4, most=3, integer=True)
    with pytest.raises(ValueError, match=r"^n is 2\.5; it must be an integer"):
        positive("n", 2.5, integer=True)
