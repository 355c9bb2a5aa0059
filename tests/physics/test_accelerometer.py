"""The one term table, the mountings, and the error model of Eq. 7."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from counterspin.physics.accelerometer import (
    DIRECTIONS,
    QX,
    QY,
    QZ,
    TERMS,
    Mounting,
    Term,
    direction,
    indicated,
)
from counterspin.physics.shared_terms import DEGREE_PER_HOUR, PLATFORM_TERMS, PlatformTerm, term

SETTINGS = settings(deadline=None, derandomize=True, max_examples=60)

# --- the table ------------------------------------------------------------------------------


def test_no_term_is_listed_twice():
    symbols = [*TERMS, *PLATFORM_TERMS]
    assert len(symbols) == len(set(symbols)) == 13 + 27
    assert all(row.symbol == symbol for symbol, row in (TERMS | PLATFORM_TERMS).items())
    # No product under two names, in whatever order its factors are written.
    products = [tuple(sorted(row.factors)) for row in TERMS.values()]
    assert len(set(products)) == len(products)
    assert len({row.ieee.lower() for row in TERMS.values()}) == len(TERMS)
    assert len({row.words for row in (TERMS | PLATFORM_TERMS).values()}) == len(symbols)
    effects = [(row.kind, row.axis, row.force_axis) for row in PLATFORM_TERMS.values()]
    assert len(set(effects)) == len(effects)


# Eq. 7 extended to IEEE Std 1293, by hand: value of each signed product at (i, p, o).
EQUATION_7 = {
    "K_F": lambda i, p, o: 1.0,
    "K_I": lambda i, p, o: i,
    "K_II": lambda i, p, o: i * i,
    "K_III": lambda i, p, o: i * i * i,
    "K_4": lambda i, p, o: i**4,
    "K_IP": lambda i, p, o: i * p,
    "K_IO": lambda i, p, o: i * o,
    "K_PO": lambda i, p, o: p * o,
    "K_PP": lambda i, p, o: p * p,
    "K_OO": lambda i, p, o: o * o,
    "K_OQ": lambda i, p, o: i * abs(i),
    "delta_O": lambda i, p, o: p,
    "delta_P": lambda i, p, o: -o,
}
IEEE = dict(
    zip(
        EQUATION_7,
        [
            "K0",
            "K1",
            "K2",
            "K3",
            "K4",
            "Kip",
            "Kio",
            "Kpo",
            "Kpp",
            "Koo",
            "Koq",
            "delta_o",
            "delta_p",
        ],
        strict=True,
    )
)


@pytest.mark.parametrize("symbol", EQUATION_7)
def test_every_product_is_that_of_equation_7(symbol):
    for ipo in itertools.product([-1.5, 0.7, 2.0], [-0.9, 1.1], [0.3, -2.2]):
        expected = EQUATION_7[symbol](*ipo)
        assert TERMS[symbol].evaluate(np.array(ipo)) == pytest.approx(expected, rel=1e-15)
    assert TERMS[symbol].ieee == IEEE[symbol]


def test_products_keep_the_shape_of_their_times():
    force = np.random.default_rng(1).normal(size=(3, 4, 5))
    for symbol, row in TERMS.items():
        expected = np.broadcast_to(EQUATION_7[symbol](*force), (4, 5))
        np.testing.assert_allclose(row.evaluate(force), expected, rtol=1e-15)


@pytest.mark.parametrize("symbol", EQUATION_7)
def test_units_follow_the_degree_of_the_product(symbol):
    """In g-units a coefficient of degree n has the unit g/g^n: doubling the force shows n."""
    row = TERMS[symbol]
    force = np.array([1.3, -0.7, 0.4])
    degree = round(math.log2(row.evaluate(2 * force) / row.evaluate(force)))
    if symbol.startswith("delta"):
        assert degree == 1
        assert row.unit == "rad"
    else:
        assert row.unit == {0: "g", 1: "g/g", 2: "g/g^2", 3: "g/g^3", 4: "g/g^4"}[degree]


def test_products_in_words_and_perfect_values():
    assert {s: row.product for s, row in TERMS.items() if s in ("K_F", "K_III", "K_OQ")} == {
        "K_F": "1",
        "K_III": "a_I^3",
        "K_OQ": "a_I*|a_I|",
    }
    assert TERMS["K_IP"].product == "a_I*a_P"
    nominal = {symbol: row.nominal for symbol, row in TERMS.items() if row.nominal}
    assert nominal == {"K_I": 1.0}
    assert all(row.nominal == 0.0 for row in PLATFORM_TERMS.values())
    assert all(row.limit > 0.0 for row in (TERMS | PLATFORM_TERMS).values())


def test_platform_terms_are_those_of_three_axes_and_of_nine_pairs():
    expected = {}
    for i, name in enumerate(["east", "north", "up"]):
        expected[f"platform.tilt.{name}"] = ("tilt", i, None, "rad", True)
        expected[f"platform.drift.{name}"] = ("drift", i, None, "rad/s", False)
        key = f"platform.g2_sensitivity.{name}"
        expected[key] = ("g2_sensitivity", i, None, "rad/s/g^2", False)
    for (i, a), (j, b) in itertools.product(enumerate("xyz"), repeat=2):
        key = f"platform.g_sensitivity.{a}{b}"
        expected[key] = ("g_sensitivity", i, j, "rad/s/g", False)
        expected[f"platform.compliance.{a}{b}"] = ("compliance", i, j, "rad/g", False)
    found = {
        s: (row.kind, row.axis, row.force_axis, row.unit, row.per_run)
        for s, row in PLATFORM_TERMS.items()
    }
    assert found == expected
    assert not any(row.per_run for row in TERMS.values())


def test_term_finds_rows_of_both_tables():
    assert isinstance(term("K_II"), Term)
    assert isinstance(term("platform.drift.up"), PlatformTerm)
    assert term("K_OQ") is TERMS["K_OQ"]


@pytest.mark.parametrize("symbol", ["K2", "k_ii", "", "platform.tilt.west"])
def test_term_lists_the_known_ones(symbol):
    with pytest.raises(ValueError, match=r"known: K_F, .*, platform\.compliance\.zz") as error:
        term(symbol)
    assert repr(symbol) in str(error.value)


def test_a_degree_per_hour():
    assert pytest.approx(math.pi / 180 / 3600, rel=1e-15) == DEGREE_PER_HOUR


# --- mountings ------------------------------------------------------------------------------

FORCE = np.array([0.31, -0.72, 1.04])  # a_x, a_y, a_z in g


@pytest.mark.parametrize(
    ("mounting", "expected"),
    [
        (QX, [0.31, -1.04, -0.72]),  # Eq. 8: a_x, -a_z, a_y
        (QY, [-0.72, -1.04, -0.31]),  # north, down, west
        (QZ, [1.04, 0.31, -0.72]),  # up, east, north
    ],
    ids=["QX", "QY", "QZ"],
)
def test_equation_8(mounting, expected):
    np.testing.assert_array_equal(mounting.matrix @ FORCE, expected)
    np.testing.assert_array_equal(mounting.input_axis @ FORCE, expected[0])
    assert np.linalg.det(mounting.matrix) == pytest.approx(1.0)


NAMED = [
    pair
    for pair in itertools.permutations(DIRECTIONS, 2)
    if abs(np.dot(DIRECTIONS[pair[0]], DIRECTIONS[pair[1]])) < 0.5
]


@pytest.mark.parametrize(("input_axis", "pendulous_axis"), NAMED)
def test_all_24_named_mountings_are_right_handed(input_axis, pendulous_axis):
    mounting = Mounting.from_axes(input_axis, pendulous_axis)
    i, p, o = mounting.matrix
    np.testing.assert_array_equal(np.cross(i, p), o)
    assert len(NAMED) == 24
    output = next(name for name, vector in DIRECTIONS.items() if np.array_equal(vector, o))
    assert Mounting.from_axes(input_axis, pendulous_axis, output) == mounting
    opposite = next(name for name, vector in DIRECTIONS.items() if np.array_equal(vector, -o))
    with pytest.raises(ValueError, match="left-handed"):
        Mounting.from_axes(input_axis, pendulous_axis, opposite)


def test_axes_that_are_not_at_right_angles_are_refused_with_their_angle():
    angle = math.radians(89.9)
    with pytest.raises(ValueError, match=r"they are 89\.9000 deg apart"):
        Mounting.from_axes("east", [math.cos(angle), 0.0, -math.sin(angle)])
    with pytest.raises(ValueError, match=r"they are 180\.0000 deg apart"):
        Mounting.from_axes("east", "west")
    with pytest.raises(ValueError, match="output axis must be at right angles"):
        Mounting.from_axes("east", "down", [0.0, 1.0, 0.1])


def test_axes_a_little_off_right_angles_are_made_exact():
    mounting = Mounting.from_axes([1.0, 0.0, 0.0], [5e-7, 0.0, -1.0])
    np.testing.assert_allclose(mounting.matrix @ mounting.matrix.T, np.eye(3), atol=1e-15)
    np.testing.assert_array_equal(mounting.input_axis, [1.0, 0.0, 0.0])


def test_direction_normalises_components():
    np.testing.assert_allclose(direction([3.0, 0.0, 4.0]), [0.6, 0.0, 0.8], rtol=1e-15)
    np.testing.assert_array_equal(direction("south"), [0.0, -1.0, 0.0])


@pytest.mark.parametrize(
    "value", ["East", "x", [0.0, 0.0, 0.0], [1.0, 0.0], [math.nan, 0.0, 1.0], [math.inf, 0.0, 0.0]]
)
def test_direction_refuses_what_is_none(value):
    with pytest.raises(ValueError, match="direction"):
        direction(value)


def test_turned_places_the_platform_axes():
    # The platform's x points north, y west, z up: turned by 90 degrees about the vertical.
    attitude = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert QX.turned(attitude) == QY
    assert QX.turned(np.eye(3)) == QX
    # On its side: x up, y north, z west. The input axis of Qx follows x, of Qz follows z.
    side = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    assert QX.turned(side) == Mounting.from_axes("up", "east", "north")
    assert QZ.turned(side) == Mounting.from_axes("west", "up", "north")


# --- Eq. 7 ----------------------------------------------------------------------------------


def test_a_perfect_accelerometer_indicates_the_force_along_its_input_axis():
    force = np.random.default_rng(2).normal(size=(7, 3))
    for mounting in (QX, QY, QZ):
        expected = force @ mounting.input_axis
        np.testing.assert_array_equal(indicated(mounting, {}, force), expected)


def test_equation_7_by_hand():
    coefficients = {symbol: 0.01 * (k + 1) for k, symbol in enumerate(EQUATION_7)}
    coefficients["K_I"] = 1.001
    i, p, o = 0.31, -1.04, -0.72
    expected = (
        0.01
        + 1.001 * i
        + 0.03 * i**2
        + 0.04 * i**3
        + 0.05 * i**4
        + 0.06 * i * p
        + 0.07 * i * o
        + 0.08 * p * o
        + 0.09 * p**2
        + 0.10 * o**2
        + 0.11 * i * abs(i)
        + 0.12 * p
        - 0.13 * o
    )
    got = indicated(QX, coefficients, np.stack([FORCE, -FORCE]))
    assert got[0] == pytest.approx(expected, rel=1e-15)
    # Reversing the force reverses the odd products and keeps the even ones.
    even = 0.01 + 0.03 * i**2 + 0.05 * i**4 + 0.06 * i * p + 0.07 * i * o + 0.08 * p * o
    even += 0.09 * p**2 + 0.10 * o**2
    assert got[0] + got[1] == pytest.approx(2 * even, rel=1e-14)


def test_misalignments_are_small_turns_of_the_case():
    """delta_O turns the input axis about the output axis towards the pendulous, and so on."""
    angle = 1e-4
    i, p, o = QX.matrix
    about_o = math.cos(angle) * i + math.sin(angle) * p
    about_p = math.cos(angle) * i - math.sin(angle) * o
    for symbol, turned in (("delta_O", about_o), ("delta_P", about_p)):
        got = indicated(QX, {symbol: angle}, FORCE[None])[0]
        assert got == pytest.approx(turned @ FORCE, abs=angle**2)
        assert abs(got - i @ FORCE) > 5e-5


def test_coefficients_of_the_platform_are_refused():
    with pytest.raises(ValueError, match=r"not accelerometer terms: K2, platform\.tilt\.north"):
        indicated(QX, {"platform.tilt.north": 1e-4, "K2": 0.0, "K_I": 1.0}, FORCE[None])


sizes = st.floats(-1.0, 1.0)


@SETTINGS
@given(
    first=st.dictionaries(st.sampled_from(list(TERMS)), sizes),
    second=st.dictionaries(st.sampled_from(list(TERMS)), sizes),
    force=st.lists(st.floats(-5.0, 5.0), min_size=3, max_size=3),
)
def test_the_indication_is_linear_in_the_coefficients(first, second, force):
    def departure(coefficients):
        # From a coefficient of zero, so that the nominal value does not come in between.
        full = dict.fromkeys(TERMS, 0.0) | coefficients
        return indicated(QY, full, np.array([force]))[0]

    total = {s: first.get(s, 0.0) + 2.0 * second.get(s, 0.0) for s in TERMS}
    assert departure(total) == pytest.approx(
        departure(first) + 2.0 * departure(second), rel=1e-12, abs=1e-11
    )
