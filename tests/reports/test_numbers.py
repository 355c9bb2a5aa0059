"""Numbers rounded to their uncertainty: examples and round trips of the text."""

import math
import re
from decimal import Decimal

import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from counterspin.campaign.quantity import parse_quantity
from counterspin.reports.numbers import (
    NOT_DETERMINED,
    find_display_unit,
    format_compact,
    format_count,
    format_estimate,
    format_interval,
    format_items,
    format_number,
    format_p,
    format_probability,
    format_share,
    format_uncertainty,
    round_to_uncertainty,
)
from counterspin.units import unit_factor

BY_HAND = [
    (2.70445e-5, 3.7e-9, "g/g^2", "(2.70445 ± 0.00037) x 1e-5 g/g^2", "2.70445(37)e-5"),
    (1.0019743, 5e-6, "g/g", "1.0019743 ± 0.0000050 g/g", "1.0019743(50)"),
    (0.0050321, 2e-6, "g", "0.0050321 ± 0.0000020 g", "0.0050321(20)"),
    (-27.0444963, 0.00070123, "ug/g^2", "-27.04450 ± 0.00070 ug/g^2", "-27.04450(70)"),
    # The uncertainty may exceed the value, and zero has no sign.
    (0.3e-9, 1.2e-9, "m", "(0.3 ± 1.2) x 1e-9 m", "0.3(1.2)e-9"),
    (-0.001, 0.31, "arcsec", "0.00 ± 0.31 arcsec", "0.00(31)"),
    (0.0, 0.5, "arcsec", "0.00 ± 0.50 arcsec", "0.00(50)"),
    # Rounding adds a digit.
    (12.3456, 0.0996, "m", "12.35 ± 0.10 m", "12.35(10)"),
    (999999.6, 1.0, "m", "999999.6 ± 1.0 m", "999999.6(1.0)"),
    (999999.96, 1.0, "m", "(1.0000000 ± 0.0000010) x 1e6 m", "1.0000000(10)e6"),
    # Insignificant zeros are omitted.
    (5031.0, 104.0, "ug", "(5.03 ± 0.10) x 1e3 ug", "5.03(10)e3"),
    (5031.4, 10.4, "ug", "5031 ± 10 ug", "5031(10)"),
    (123.0, 45678.0, "m", "(0.0 ± 4.6) x 1e4 m", "0.0(4.6)e4"),
    # Decimal halves are rounded to even.
    (0.125, 0.1, "m", "0.12 ± 0.10 m", "0.12(10)"),
    (0.135, 0.1, "m", "0.14 ± 0.10 m", "0.14(10)"),
    (1.0, 0.225, "m", "1.00 ± 0.22 m", "1.00(22)"),
    # Far from one.
    (6.02214076e23, 1.2e16, "1/mol", "(6.02214076 ± 0.00000012) x 1e23 1/mol", "6.02214076(12)e23"),
    (1.5e-300, 2e-302, "m", "(1.500 ± 0.020) x 1e-300 m", "1.500(20)e-300"),
    (5e-324, 5e-324, "m", "(5.0 ± 5.0) x 1e-324 m", "5.0(5.0)e-324"),
    (1.7e308, 1.6e308, "m", "(1.7 ± 1.6) x 1e308 m", "1.7(1.6)e308"),
    # More digits than the precision of a double.
    (1.0e5, 1.0e-20, "m", "100000 ± 1e-20 m", "100000 ± 1e-20"),
    # No value and no uncertainty.
    (9.8066, 0.0, "m/s^2", "9.8066 m/s^2 (exact)", "9.8066"),
    (9.80661234, None, "m/s^2", "9.80661 m/s^2", "9.80661"),
    (0.0, 0.0, "m", "0 m (exact)", "0"),
    (None, None, "g", NOT_DETERMINED, NOT_DETERMINED),
    (None, 0.1, "g", NOT_DETERMINED, NOT_DETERMINED),
    (1.0, math.inf, "g", NOT_DETERMINED, NOT_DETERMINED),
    (1.0, math.nan, "g", NOT_DETERMINED, NOT_DETERMINED),
    (math.nan, 1.0, "g", NOT_DETERMINED, NOT_DETERMINED),
    (1.0, 0.1, "", "1.00 ± 0.10", "1.00(10)"),
]


@pytest.mark.parametrize(("value", "u", "unit", "expected", "compact"), BY_HAND)
def test_estimate_format(value, u, unit, expected, compact):
    assert format_estimate(value, u, unit) == expected
    assert format_compact(value, u) == compact


def test_rejects_negative_uncertainty():
    for write in (format_estimate, format_compact):
        with pytest.raises(ValueError, match="cannot be negative; got -1"):
            write(1.0, -1.0)


magnitudes = st.floats(min_value=1e-12, max_value=1e12)
values = st.one_of(st.just(0.0), magnitudes, magnitudes.map(lambda x: -x))

ESTIMATE = re.compile(r"\(?(-?[\d.]+) ± ([\d.]+)(?:\) x 1e(-?\d+))?")
COMPACT = re.compile(r"(-?[\d.]+)\(([\d.]+)\)(?:e(-?\d+))?")


def second_digit_step(u):
    """Return the size of the second digit of u, not above 1/9.95 of u: 0.0996 counts as 0.10."""
    return 10.0 ** (math.floor(math.log10(float(f"{Decimal(repr(u)):.1e}")) + 1e-9) - 1)


@given(values, magnitudes)
@example(9.949999e-7, 9.949999e-7)
@example(1.0, 0.995)
@example(1.5, 9.95)
def test_text_parses_to_value_within_rounding(value, u):
    assume(abs(value) / u < 1e13)
    match = ESTIMATE.fullmatch(format_estimate(value, u))
    scale = 10.0 ** int(match[3] or 0)
    slack = 0.5 * second_digit_step(u) * (1 + 1e-9) + 1e-15 * abs(value)
    assert abs(float(match[1]) * scale - value) <= slack
    assert abs(float(match[2]) * scale - u) <= slack


@given(values, magnitudes)
def test_uncertainty_has_two_digits_and_value_same_decimals(value, u):
    assume(abs(value) / u < 1e13)
    both = round_to_uncertainty(value, u)
    assert len(both.u.replace(".", "").lstrip("0")) == 2
    assert len(both.value.partition(".")[2]) == len(both.u.partition(".")[2])
    assert both.value.lstrip("-0.") or not both.value.startswith("-")
    leading = max(abs(float(both.value)), float(both.u))
    assert 1.0 <= leading < 10.0 if both.exponent else 1e-3 <= leading < 1e6


@given(values, magnitudes)
def test_compact_form_agrees_with_plus_minus_form(value, u):
    assume(abs(value) / u < 1e13)
    both = round_to_uncertainty(value, u)
    match = COMPACT.fullmatch(format_compact(value, u))
    assert match[1] == both.value
    assert int(match[3] or 0) == both.exponent
    decimals = len(both.value.partition(".")[2])
    last = float(match[2]) if "." in match[2] else float(match[2]) * 10.0**-decimals
    assert last == pytest.approx(float(both.u), rel=1e-12)


@given(st.floats(min_value=-1e5, max_value=1e5), st.floats(min_value=1e-6, max_value=9.0))
def test_text_without_power_of_ten_is_valid_in_campaign_file(value, u):
    text = format_estimate(value, u, "ug/g^2")
    assume("x 1e" not in text)
    read = parse_quantity(text, "g/g^2")
    both = round_to_uncertainty(value, u)
    assert read.value == pytest.approx(1e-6 * float(both.value), rel=1e-12)
    assert read.u == pytest.approx(1e-6 * float(both.u), rel=1e-12)


@pytest.mark.parametrize("u", [1e-7, 1.0, 1e7])
@pytest.mark.parametrize("digits", [12, 14, 15, 16, 18])
def test_at_most_fifteen_digits_are_written(u, digits):
    value = u * 10.0 ** (digits - 2) * 1.2345
    text = format_estimate(value, u)
    both = round_to_uncertainty(value, u)
    if digits <= 15:
        assert len(re.sub(r"\D", "", both.value).lstrip("0")) == digits
    else:
        assert both is None
        shown, spread = text.split(" ± ")
        assert float(shown) == value
        assert float(spread) == u


@pytest.mark.parametrize(
    ("value", "u", "half_width", "expected"),
    [
        (27.0445, 0.0007, 0.001372, "27.04313 to 27.04587 ug/g^2"),
        (2.70445e-5, 3.7e-9, 7.252e-9, "(2.70372 to 2.70518) x 1e-5 ug/g^2"),
        (0.1, 0.5, 0.98, "-0.88 to 1.08 ug/g^2"),
        (9.9, 1.0, 2.0, "7.9 to 11.9 ug/g^2"),
        (1e5, 1e-20, 1.0, "99999 to 100001 ug/g^2"),
    ],
)
def test_interval_has_decimals_of_uncertainty(value, u, half_width, expected):
    assert format_interval(value, u, half_width, "ug/g^2") == expected


@pytest.mark.parametrize(
    ("value", "digits", "expected"),
    [
        (0.0099812, 3, "0.00998"),
        (1.23456e-9, 3, "1.23e-9"),
        (-2.5e21, 2, "-2.5e21"),
        (35000.0, 6, "35000"),
        (2.5, 6, "2.5"),
        (0.0, 3, "0"),
        (math.inf, 3, "inf"),
    ],
)
def test_number_without_uncertainty(value, digits, expected):
    assert format_number(value, digits) == expected


@pytest.mark.parametrize(
    ("u", "expected"),
    [
        (0.07, "0.070"),
        (1.0, "1.0"),
        (0.00099501, "0.0010"),
        (6e-7, "6.0e-7"),
        (43.2, "43"),
        (0, "0"),
    ],
)
def test_uncertainty_alone_has_two_digits(u, expected):
    assert format_uncertainty(u) == expected


@pytest.mark.parametrize(
    ("count", "expected"), [(21659.98, "21660"), (20.81, "20.81"), (798.44, "798.4"), (51.0, "51")]
)
def test_large_counts_are_integers(count, expected):
    assert format_count(count) == expected


@pytest.mark.parametrize(
    ("share", "expected"),
    [
        (1.0, "100 %"),
        (0.9949, "99 %"),
        (0.0996, "10 %"),
        (0.0994, "9.9 %"),
        (0.0005, "0.1 %"),
        (0.0004, "< 0.1 %"),
        (0.0, "0.0 %"),
    ],
)
def test_share_format(share, expected):
    assert format_share(share) == expected


@pytest.mark.parametrize(
    ("probability", "expected"),
    [
        (0.0, "< 0.1 %"),
        (0.00049, "< 0.1 %"),
        (0.0006, "0.1 %"),
        (0.0249, "2.5 %"),
        (0.95, "95.0 %"),
        (0.9994, "99.9 %"),
        (0.99951, "> 99.9 %"),
        (1.0, "> 99.9 %"),
    ],
)
def test_probability_is_not_rounded_to_0_or_1(probability, expected):
    assert format_probability(probability) == expected


@pytest.mark.parametrize("unit", ["g", "g/g^2", "g/g^3", "rad", "rad/s", "rad/s/g", "1/s"])
def test_field_units_are_valid_in_campaign_files(unit):
    shown, factor = find_display_unit(unit)
    assert shown != unit
    assert factor * unit_factor(shown, unit) == pytest.approx(1.0, rel=1e-14)


def test_other_units_are_unchanged():
    assert find_display_unit("g/g") == ("g/g", 1.0)
    assert find_display_unit("m/s^2") == ("m/s^2", 1.0)


def test_underflowed_p_is_not_zero():
    assert [format_p(p) for p in (0.5, 1e-9, 0.0)] == ["p = 0.5", "p = 1e-9", "p < 1e-300"]


def test_single_item_is_singular():
    assert [format_items(n, "gap") for n in (0, 1, 2)] == ["0 gaps", "1 gap", "2 gaps"]
