"""The mountings, and the error model of Eq. 7."""

import itertools
import math

import numpy as np
import pytest
from equation_7 import EQUATION_7
from hypothesis import given, settings
from hypothesis import strategies as st

from counterspin.physics.accelerometer import DIRECTIONS, QX, QY, QZ, Mounting, direction, indicated
from counterspin.physics.terms import TERMS

SETTINGS = settings(deadline=None, derandomize=True, max_examples=60)

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
def test_mountings_of_equation_8(mounting, expected):
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


def test_nonorthogonal_axes_raise_with_angle():
    angle = math.radians(89.9)
    with pytest.raises(ValueError, match=r"they are 89\.9000 deg apart"):
        Mounting.from_axes("east", [math.cos(angle), 0.0, -math.sin(angle)])
    with pytest.raises(ValueError, match=r"they are 180\.0000 deg apart"):
        Mounting.from_axes("east", "west")
    with pytest.raises(ValueError, match="output axis must be at right angles"):
        Mounting.from_axes("east", "down", [0.0, 1.0, 0.1])


def test_nearly_orthogonal_axes_are_orthogonalised():
    mounting = Mounting.from_axes([1.0, 0.0, 0.0], [5e-7, 0.0, -1.0])
    np.testing.assert_allclose(mounting.matrix @ mounting.matrix.T, np.eye(3), atol=1e-15)
    np.testing.assert_array_equal(mounting.input_axis, [1.0, 0.0, 0.0])


def test_direction_normalises_components():
    np.testing.assert_allclose(direction([3.0, 0.0, 4.0]), [0.6, 0.0, 0.8], rtol=1e-15)
    np.testing.assert_array_equal(direction("south"), [0.0, -1.0, 0.0])


@pytest.mark.parametrize(
    "value", ["East", "x", [0.0, 0.0, 0.0], [1.0, 0.0], [math.nan, 0.0, 1.0], [math.inf, 0.0, 0.0]]
)
def test_direction_rejects_invalid_vector(value):
    with pytest.raises(ValueError, match="direction"):
        direction(value)


def test_turned_mounting_rotates_axes_with_platform():
    # The platform's x points north, y west, z up: turned by 90 degrees about the vertical.
    attitude = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert QX.turned(attitude) == QY
    assert QX.turned(np.eye(3)) == QX
    # On its side: x up, y north, z west. The input axis of Qx follows x, of Qz follows z.
    side = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    assert QX.turned(side) == Mounting.from_axes("up", "east", "north")
    assert QZ.turned(side) == Mounting.from_axes("west", "up", "north")


# --- Eq. 7 ----------------------------------------------------------------------------------


def test_perfect_accelerometer_indicates_force_along_input_axis():
    force = np.random.default_rng(2).normal(size=(7, 3))
    for mounting in (QX, QY, QZ):
        expected = force @ mounting.input_axis
        np.testing.assert_array_equal(indicated(mounting, {}, force), expected)


def test_equation_7_matches_hand_calculation():
    symbols = ("K_F", "K_I", "K_II", "K_III", "K_4", "K_IP", "K_IO", "K_PO", "K_PP", "K_OO", "K_OQ")
    symbols += ("delta_O", "delta_P", "K_5", "K_0_asym", "K_I_asym", "K_spin", "K_ang")
    assert set(symbols) == set(EQUATION_7)
    coefficients = {symbol: 0.01 * (k + 1) for k, symbol in enumerate(symbols)}
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
        + 0.14 * i**5
        + 0.15 / 2
        + 0.16 * i / 2
    )
    got = indicated(QX, coefficients, np.stack([FORCE, -FORCE]))
    assert got[0] == pytest.approx(expected, rel=1e-15)
    # Reversing the force reverses the odd products and keeps the even ones.
    even = 0.01 + 0.03 * i**2 + 0.05 * i**4 + 0.06 * i * p + 0.07 * i * o + 0.08 * p * o
    even += 0.09 * p**2 + 0.10 * o**2 + 0.16 * i / 2
    assert got[0] + got[1] == pytest.approx(2 * even, rel=1e-14)


def test_misalignments_are_small_rotations_of_case():
    """delta_O turns the input axis about the output axis towards the pendulous, and so on."""
    angle = 1e-4
    i, p, o = QX.matrix
    about_o = math.cos(angle) * i + math.sin(angle) * p
    about_p = math.cos(angle) * i - math.sin(angle) * o
    for symbol, turned in (("delta_O", about_o), ("delta_P", about_p)):
        got = indicated(QX, {symbol: angle}, FORCE[None])[0]
        assert got == pytest.approx(turned @ FORCE, abs=angle**2)
        assert abs(got - i @ FORCE) > 5e-5


def test_platform_coefficients_raise():
    with pytest.raises(ValueError, match=r"not accelerometer terms: K2, platform\.tilt\.north"):
        indicated(QX, {"platform.tilt.north": 1e-4, "K2": 0.0, "K_I": 1.0}, FORCE[None])


sizes = st.floats(-1.0, 1.0)


@SETTINGS
@given(
    first=st.dictionaries(st.sampled_from(list(TERMS)), sizes),
    second=st.dictionaries(st.sampled_from(list(TERMS)), sizes),
    force=st.lists(st.floats(-5.0, 5.0), min_size=3, max_size=3),
)
def test_indication_is_linear_in_coefficients(first, second, force):
    def departure(coefficients):
        # From a coefficient of zero, so that the nominal value does not come in between.
        full = dict.fromkeys(TERMS, 0.0) | coefficients
        return indicated(QY, full, np.array([force]))[0]

    total = {s: first.get(s, 0.0) + 2.0 * second.get(s, 0.0) for s in TERMS}
    assert departure(total) == pytest.approx(
        departure(first) + 2.0 * departure(second), rel=1e-12, abs=1e-11
    )
