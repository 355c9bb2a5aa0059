import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from counterspin.campaign.quantity import (
    Quantity,
    describe_attitude,
    last_digit_step,
    normalize_latitude,
    parse_quantity,
    read_attitude_matrix,
)
from counterspin.physics.terms import SHARED_TERMS, TERMS
from counterspin.units import QUANTITIES, UNITS, unit_factor

G = 9.8066
UNCERTAINTY = st.one_of(st.just(0.0), st.floats(min_value=1e-50, max_value=1e50))
FINITE = st.builds(math.copysign, UNCERTAINTY, st.sampled_from([1.0, -1.0]))


@pytest.mark.parametrize(
    ("text", "unit", "value", "u"),
    [
        ("2.5 m", "m", 2.5, 0.0),
        ("2.5 ± 1e-5 m", "m", 2.5, 1e-5),
        ("2.5 +/- 1e-5 m", "m", 2.5, 1e-5),
        ("2.5 +- 1e-5 m", "m", 2.5, 1e-5),
        ("  2.5±1e-5m ", "m", 2.5, 1e-5),
        ("2500 ± 0.01 mm", "m", 2.5, 1e-5),
        ("100 in", "m", 2.54, 0.0),
        ("10 ± 0.01 ft", "m", 3.048, 0.003048),
        ("100 gon", "rad", math.pi / 2, 0.0),
        ("32.174 ft/s^2", "m/s^2", 9.80663520, 0.0),
        ("-45.75 deg", "rad", math.radians(-45.75), 0.0),
        ("−45.75 °", "rad", math.radians(-45.75), 0.0),
        ("0 ± 0.5 arcsec", "rad", 0.0, math.radians(0.5 / 3600)),
        ("60 rpm", "rad/s", 2 * math.pi, 0.0),
        ("1 rev/s", "rad/s", 2 * math.pi, 0.0),
        ("15 deg/h", "rad/s", math.radians(15) / 3600, 0.0),
        ("0.02 deg/h/g", "rad/s/g", math.radians(0.02) / 3600, 0.0),
        ("3.6e-3 1/h", "1/s", 1e-6, 0.0),
        ("3600 ppm/h", "1/s", 1e-6, 0.0),
        ("50 Hz", "Hz", 50.0, 0.0),
        ("1 us", "s", 1e-6, 0.0),
        ("1 µs", "s", 1e-6, 0.0),
        ("5 μg", "g", 5e-6, 0.0),
        ("5 ug", "g", 5e-6, 0.0),
        ("20 ug/g^2", "g/g^2", 2e-5, 0.0),
        ("20 ug/g**2", "g/g^2", 2e-5, 0.0),
        ("20 ug/g²", "g/g^2", 2e-5, 0.0),
        ("1.0019743 ± 5e-6 g/g", "g/g", 1.0019743, 5e-6),
        ("300 ppm", "1", 3e-4, 0.0),
        ("0.5 1", "1", 0.5, 0.0),
        ("9.8066 m s^-2", "m/s^2", 9.8066, 0.0),
        ("9.8066 m/(s s)", "m/s^2", 9.8066, 0.0),
        ("9.8066 m/((s) (s)) * s/s", "m/s^2", 9.8066, 0.0),
        ("9.8066 1/(s^2/m)", "m/s^2", 9.8066, 0.0),
        ("9.8066 1/(s/(m/s))", "m/s^2", 9.8066, 0.0),
        ("9.8066 m^0.5 m^0.5/s/s", "m/s^2", 9.8066, 0.0),
    ],
)
def test_quantity_is_parsed(text, unit, value, u):
    quantity = parse_quantity(text, unit)
    assert quantity.value == pytest.approx(value, rel=4e-16, abs=0.0)
    assert quantity.u == pytest.approx(u, rel=4e-16, abs=0.0)
    assert quantity.unit == unit


@pytest.mark.parametrize(
    ("text", "degrees"),
    [
        ("45.75N", 45.75),
        ("45.75° S", -45.75),
        ("N 45.75", 45.75),
        ("S45° 45' ", -45.75),
        ("45 deg 45 min N", 45.75),
        ("45°45'36\"S", -45.76),
        ("45.75 ± 0.1 deg", 45.75),
    ],
)
def test_latitude_with_minutes_and_hemisphere(text, degrees):
    assert parse_quantity(normalize_latitude(text), "rad").value == pytest.approx(
        math.radians(degrees)
    )


def test_rejects_latitude_with_60_minutes():
    with pytest.raises(ValueError, match="less than 60"):
        normalize_latitude("45 deg 75 min N")


@pytest.mark.parametrize(
    "text", ["45.75 degs", "45.75 degN", "45 deg 45 min 30 s", "45.75 n", "45.75 deg", "N 45.75 S"]
)
def test_misspelt_unit_is_not_a_hemisphere(text):
    assert normalize_latitude(text) == text


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("0.049033 m/s^2", "g", 0.005),
        ("1 m^-1 s^2", "g/g^2", G),
        ("3e-6 g/Hz^0.5", "m/s^2/Hz^0.5", 3e-6 * G),
        ("2e-5 m/s/s^0.5", "m/s^2/Hz^0.5", 2e-5),
        ("1 mg", "m/s^2", 1e-3 * G),
    ],
)
def test_site_gravity_converts_between_g_and_si(text, unit, value):
    assert parse_quantity(text, unit, gravity=G).value == pytest.approx(value, rel=1e-15)


def test_rejects_g_for_si_without_gravity():
    with pytest.raises(ValueError, match=r"'g' is not a unit of acceleration; use m/s\^2"):
        parse_quantity("1 g", "m/s^2")


@pytest.mark.parametrize(
    ("text", "unit", "message"),
    [
        (2.5, "m", r'has no unit; write "2.5 m" \(a length: m, mm, um, km\)'),
        (0.5, "rad", r'write "0.5 deg", "0.5 arcsec" or "0.5 rad", whichever applies \(an angle:'),
        (float("nan"), "m", "nan is not a finite number"),
        (True, "m", "must be a length, written as text"),
        ([1], "m", "must be a length, written as text"),
        ("2.5", "m", "'2.5' has no unit; a length is required"),
        ("2.5 ± 1", "m", r'has no unit; a length is required \(.*\); write "2.5 ± 1 m"$'),
        ("0.5", "rad", r'; write "0.5 deg", "0.5 arcsec" or "0.5 rad", whichever applies$'),
        ("m", "m", "is not a quantity"),
        ("", "m", "is not a quantity"),
        ("1 ± m", "m", "is not a unit; a length is required"),
        ("2,5 m", "m", "contains a comma; use a decimal point"),
        ("1 ± 2 ± 3 m", "m", "is not a unit"),
        ("nan m", "m", "not a finite number"),
        ("1 ± inf m", "m", "not a finite number"),
        ("-Infinity m", "m", "not a finite number"),
        ("1e999 m", "m", "not a finite number"),
        ("1 ± -2 m", "m", "negative uncertainty"),
        ("1 furlong", "m", r"unknown unit 'furlong'; a length is required \(m, mm, um, km\)"),
        ("1 M", "m", "unknown unit 'M'"),
        ("1 s", "m", "'s' is not a unit of length; use m, mm, um, km"),
        ("1 1/s", "rad/s", "'1/s' is not a unit of angular rate; use rad/s, deg/s"),
        ("1 rad/s", "1/s", "not a unit of relative drift"),
        ("2.5 m ± 1 mm", "m", r'at the end: "2.5 ± 0.001 m"$'),
        ("2.5 m +/- 0.001", "m", r'at the end: "2.5 ± 0.001 m"$'),
        ("1.0019 g/g ± 5 ppm", "g/g", r'at the end: "1.0019 ± 5e-06 g/g"$'),
        ("2.5 m ± 1 s", "m", r'at the end: "VALUE ± U UNIT"$'),
        ("1 m1", "m", "'m1' is not a unit"),
        ("1 m)", "m", "'m\\)' is not a unit: a factor or a parenthesis is missing"),
        ("1 1/(s", "1/s", "a factor or a parenthesis is missing"),
        ("1 m^-99 km^99 km^99", "m", "is not a unit of length"),
        ("1 Hz", "rad/s", "'Hz' is ambiguous for an angular rate: write rev/s"),
        ("1 Hz", "1/s", "'Hz' is a frequency; a relative drift is required"),
        ("1 g/g^2", "g/g^3", "not a unit of third-order coefficient"),
        ("1 g", "rad", "not a unit of angle"),
        ("1 m//s", "m/s", "is not a unit"),
        ("1 m/", "m", "is not a unit"),
        ("1 (m", "m", "is not a unit"),
        ("1 m^9^9^9", "m", "is not a unit"),
        ("1 __import__('os')", "m", "is not a unit"),
    ],
)
def test_rejects_with_advice(text, unit, message):
    with pytest.raises(ValueError, match=message):
        parse_quantity(text, unit)


@pytest.mark.parametrize("wanted", QUANTITIES)
def test_advised_units_are_accepted(wanted):
    for unit in QUANTITIES[wanted][1].split(", "):
        assert unit_factor(unit, wanted, gravity=G) > 0.0


def test_all_term_units_have_advice():
    assert {row.unit for row in [*TERMS.values(), *SHARED_TERMS.values()]} <= set(QUANTITIES)


@given(FINITE, UNCERTAINTY, st.sampled_from(sorted(QUANTITIES)))
def test_quantity_round_trips_exactly(value, u, unit):
    assume(max(abs(value), u) < 1e9 or unit not in ("rad", "s"))
    quantity = Quantity(value, u, unit)
    assert parse_quantity(str(quantity), unit) == quantity


@pytest.mark.parametrize(
    ("text", "unit", "kind"),
    [
        ("1e18 rad", "rad", "an angle"),
        ("6e10 deg", "rad", "an angle"),
        ("0 ± 1e18 rad", "rad", "an angle"),
        ("1e18 s", "s", "a time"),
    ],
)
def test_rejects_implausible_angles_and_times(text, unit, kind):
    with pytest.raises(ValueError, match=f"implausibly large or small; {kind} is required"):
        parse_quantity(text, unit)
    parse_quantity(text.replace("e18", "e8").replace("e10", "e9"), unit)


@given(st.sampled_from(sorted(UNITS)), st.sampled_from(sorted(UNITS)))
def test_factors_of_same_dimension_are_inverse(unit, other):
    try:
        there = unit_factor(unit, other)
    except ValueError:
        return
    assert there * unit_factor(other, unit) == pytest.approx(1.0, rel=1e-15)


@pytest.mark.slow
@given(st.text(max_size=20))
def test_any_text_is_quantity_or_raises_value_error(text):
    try:
        quantity = parse_quantity(text, "m")
    except ValueError:
        return
    assert math.isfinite(quantity.value)


@pytest.mark.parametrize("text", ["1e300 m", "-1e61 m", "2.5 ± 1e-300 m", "1e-64 km"])
def test_rejects_implausible_lengths(text):
    with pytest.raises(ValueError, match="is implausibly large or small; a length is required"):
        parse_quantity(text, "m")


@pytest.mark.parametrize(
    ("text", "one"),
    [
        ("1.250 mA", "1e-3 mA"),
        ("-0.5g", "1e-1g"),
        ("−12 mg", "1e0 mg"),
        ("6.28e-4 A", "1e-6 A"),
        (".5 V", "1e-1 V"),
    ],
)
def test_last_digit_of_quantity(text, one):
    assert last_digit_step(text) == one


def test_quantity_object_is_converted():
    assert parse_quantity(Quantity(2.5, 1.0, "mA"), "A") == parse_quantity("2.5 ± 1.0 mA", "A")
    assert parse_quantity(Quantity(2.0, 0.0, "m/s^2"), "g", gravity=8.0) == Quantity(0.25, 0.0, "g")
    for wrong, words in (
        (Quantity(1e300, 0.0, "A"), "implausibly large"),
        (Quantity(float("inf"), 0.0, "A"), "not a finite number"),
        (Quantity(1.0, -1.0, "A"), "negative uncertainty"),
    ):
        with pytest.raises(ValueError, match=words):
            parse_quantity(wrong, "A")


@pytest.mark.parametrize(
    ("written", "words"),
    [
        ("level", "level"),
        ("90 deg about east", "x east, y up, z south"),
        ({"x": "north", "y": "west"}, "x north, y west, z up"),
        ("30 deg about up", "x [0.866, 0.5, 0], y [-0.5, 0.866, 0], z up"),
    ],
)
def test_attitude_is_described_by_directions_of_axes(written, words):
    assert describe_attitude(read_attitude_matrix(written)) == words
