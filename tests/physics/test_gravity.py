"""Normal gravity against published values."""

import math

import pytest

from counterspin.physics.gravity import HEIGHT_RANGE, gravity_range, latitude_range, normal_gravity
from counterspin.validation.cases import case
from counterspin.validation.validate import check_case


@pytest.mark.parametrize("where", ["at the equator", "at a pole", "at 45 degrees"])
def test_normal_gravity_matches_published_values(where):
    stated = case(f"normal gravity {where}")
    assert check_case(stated).state == "passed"
    south = normal_gravity(-math.radians(stated.given["degrees"]))
    assert south == pytest.approx(float(stated.expected["gravity"]), abs=stated.absolute_tolerance)


def test_gravity_decreases_by_free_air_gradient():
    # Hofmann-Wellenhof and Moritz, Physical Geodesy (2006), Eq. 3-32: 0.3086 mGal/m.
    at_45 = math.radians(45.0)
    gradient = (normal_gravity(at_45, 1.0) - normal_gravity(at_45, -1.0)) / 2.0
    assert gradient == pytest.approx(-0.3086e-5, rel=5e-4)


def gravity_from_potential(latitude, height):
    """Return the gravity outside the ellipsoid from its potential (TR 8350.2, ch. 4)."""
    mp = pytest.importorskip("mpmath")
    mp.mp.dps = 40
    a, f, gm = mp.mpf(6378137), 1 / mp.mpf("298.257223563"), mp.mpf("3986004.418e8")
    rate = mp.mpf("7292115e-11")
    b = a * (1 - f)
    e = mp.sqrt(a**2 - b**2)

    def q(u):
        return ((1 + 3 * u**2 / e**2) * mp.atan(e / u) - 3 * u / e) / 2

    def potential(x, z):
        r2 = x**2 + z**2 - e**2
        u = mp.sqrt(r2 / 2 * (1 + mp.sqrt(1 + 4 * e**2 * z**2 / r2**2)))
        sine = z / u
        field = (
            gm / e * mp.atan(e / u) + rate**2 * a**2 * q(u) / q(b) * (sine**2 - mp.mpf(1) / 3) / 2
        )
        return field + rate**2 * x**2 / 2

    sine, cosine = mp.sin(latitude), mp.cos(latitude)
    normal = a**2 / mp.sqrt((a * cosine) ** 2 + (b * sine) ** 2)
    x = (normal + height) * cosine
    z = (normal * (b / a) ** 2 + height) * sine
    step = mp.mpf("0.001")
    along = (potential(x + step, z) - potential(x - step, z)) / (2 * step)
    up = (potential(x, z + step) - potential(x, z - step)) / (2 * step)
    return float(mp.sqrt(along**2 + up**2))


@pytest.mark.parametrize("height", HEIGHT_RANGE)
@pytest.mark.parametrize("latitude", [0.2, 0.8, 1.3])
def test_gravity_at_height_matches_ellipsoid_potential(latitude, height):
    assert normal_gravity(latitude, height) == pytest.approx(
        gravity_from_potential(latitude, height), abs=4e-7
    )


def test_gravity_limits_are_those_of_extreme_heights():
    low, high = gravity_range(math.radians(45.75))
    assert low == normal_gravity(math.radians(45.75), 3000.0)
    assert high == normal_gravity(math.radians(45.75), -500.0)
    assert low < 9.8
    assert high > 9.8066


def test_latitudes_with_gravity_match_formula_of_1967():
    """Compare with the formula of 1967 and a free-air gradient of 3.086e-6 1/s^2 to 0.1 deg."""

    def square(gravity):
        return (gravity / 9.780318 - 1.0) / 0.0053024

    least, most = latitude_range(9.8066, 1e-3)
    high, low = 9.8066 + 1e-3 + 3000.0 * 3.086e-6, 9.8066 - 1e-3 - 500.0 * 3.086e-6
    assert math.sin(least) ** 2 == pytest.approx(square(low), abs=0.005)
    assert math.sin(most) ** 2 == pytest.approx(square(high), abs=0.005)
    assert latitude_range(9.7803, 1e-3)[0] == 0.0
    assert latitude_range(9.832, 1e-3)[1] == 0.5 * math.pi
    assert all(map(math.isnan, latitude_range(9.9, 1e-3)))
