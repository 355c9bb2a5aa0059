"""Stations: forces against an inertial frame in 60 digits, means against closed forms."""

import math
from dataclasses import replace
from decimal import Decimal

import numpy as np
import pytest
from stations import Station, combine_stations

from counterspin.physics.accelerometer import QX, Mounting, direction
from counterspin.physics.motion import Site, Trajectory, trajectory_sensitivity
from counterspin.physics.observation import columns
from counterspin.physics.spindle import Spindle
from counterspin.physics.station import FRAMES, mean_products
from counterspin.physics.terms import TERMS
from counterspin.validation.cases import load_document

REFERENCE = load_document("arm_forces.json")
TILTED = load_document("axis_tilt.json")
SITE = Site(9.80665, 0.8)
SYMBOLS = list(TERMS)


def station_means(station, site, symbols):
    means = mean_products(combine_stations([station]), site)[0]
    return means[[SYMBOLS.index(symbol) for symbol in symbols]]


def make_arm(inputs, pendulous, **more):
    return Station(
        "arm", Mounting.from_axes(*(FRAMES["arm"][name] for name in (inputs, pendulous))), **more
    )


@pytest.mark.parametrize("case", REFERENCE["cases"], ids=str)
def test_arm_force_matches_inertial_frame(case):
    site = Site(float(REFERENCE["gravity"]), float(case["latitude"]))
    radius, rate = float(case["radius"]), float(case["rate"])
    station = make_arm("outward", "up", rate=rate, radius=radius)
    force = station.force(site, np.array([float(case["angle"])]))[0]
    exact = np.array([float(value) for value in case["force"]])
    neglected = site.earth_rate**2 * radius
    size = np.linalg.norm(exact)
    assert np.abs(force - exact).max() < neglected + 1e-12 * size
    assert np.abs(force - exact).max() > 0.01 * neglected or float(case["angle"]) == 0.0


@pytest.mark.parametrize("rate", [3.0, -3.0])
def test_counter_rotating_force_matches_trajectory(rate):
    station = Station("counter-rotating", QX, rate=rate, radius=2.5)
    trajectory = Trajectory(Spindle(rate), 2.5, SITE)
    times = np.linspace(0.0, 2.0, 7)
    there = trajectory.specific_force(times)
    np.testing.assert_allclose(station.force(SITE, rate * times), there, rtol=0, atol=1e-13 * 25)


@pytest.mark.parametrize("case", TILTED["cases"], ids=str)
def test_tilted_arm_force_matches_inertial_frame(case):
    site = Site(float(TILTED["gravity"]), float(case["latitude"]))
    radius, rate = float(case["radius"]), float(case["rate"])
    tilt = float(case["east"]), float(case["north"])
    station = make_arm("outward", "up", rate=rate, radius=radius, axis_tilt=tilt)
    force = station.force(site, np.array([float(case["angle"])]))[0]
    exact = np.array([float(value) for value in case["arm"]])
    neglected = site.earth_rate**2 * radius
    assert np.abs(force - exact).max() < neglected + 1e-12 * np.linalg.norm(exact)


@pytest.mark.parametrize("case", TILTED["cases"], ids=str)
def test_level_platform_on_tilted_axis_moves_vertically(case):
    """Compare the derivative with respect to the tilt for readings and for records."""
    site = Site(float(TILTED["gravity"]), float(case["latitude"]))
    radius, rate = float(case["radius"]), float(case["rate"])
    angle = np.array([float(case["angle"])])
    size = radius * rate**2
    for place, about in enumerate(("east", "north")):
        exact = np.array([float(value) for value in case[f"by_{about}"]])
        tilt = (float(place == 0), float(place == 1))
        level = Station("counter-rotating", QX, rate=rate, radius=radius)
        change = replace(level, axis_tilt=tilt).force(site, angle) - level.force(site, angle)
        assert np.abs(change[0] - exact).max() < site.earth_rate**2 * radius + 1e-12 * size
        trajectory = Trajectory(Spindle(rate, start_angle=angle[0]), radius, site)
        path = trajectory_sensitivity(
            f"centrifuge.axis_tilt.{about}", trajectory.at(np.zeros(1)), 0
        )[0]
        assert np.abs(path - exact).max() < site.earth_rate**2 * radius + 1e-12 * size


def test_axis_tilt_affects_means_in_second_order():
    """Gravity along the input axis has one cycle per revolution: tilt^2 / 2 in the mean of K_II.

    That is 2e-8 g^2 at 2e-4 rad, of which a K_II of 1e-5 makes 2e-13 g.
    """
    site, tilt = Site(9.8, 0.7, earth_rate=0.0), 2e-4
    plain, tilted = (
        dict(
            zip(
                SYMBOLS, station_means(make_arm("inward", "up", **more), site, SYMBOLS), strict=True
            )
        )
        for more in (
            {"rate": 9.9, "radius": 1.0},
            {"rate": 9.9, "radius": 1.0, "axis_tilt": (tilt, 0.0)},
        )
    )
    assert tilted["K_I"] == pytest.approx(plain["K_I"], rel=1e-14)
    assert tilted["K_II"] - plain["K_II"] == pytest.approx(tilt**2 / 2.0, rel=1e-4)
    assert tilted["K_PP"] - plain["K_PP"] == pytest.approx(-(tilt**2), rel=1e-4)
    assert tilted["delta_O"] - plain["delta_O"] == pytest.approx(-(tilt**2) / 2.0, rel=1e-4)


def test_force_at_rest_is_gravity():
    station = Station("static", QX)
    np.testing.assert_array_equal(station.force(SITE, np.zeros(1)), [[0.0, 0.0, SITE.gravity]])


@pytest.mark.parametrize("rate", [9.9, -9.9])
def test_arm_means_match_closed_form(rate):
    site = Site(9.8, 0.7)
    station = make_arm("inward", "up", rate=rate, radius=1.0)
    g, omega = site.gravity, site.earth_rate
    a_i = (rate**2 + 2.0 * rate * omega * math.sin(0.7)) / g
    lift = 2.0 * rate * omega * math.cos(0.7) / g
    means = dict(zip(SYMBOLS, station_means(station, site, SYMBOLS), strict=True))
    expected = {"K_F": 1.0, "K_I": a_i, "K_II": a_i**2, "K_III": a_i**3, "K_IP": a_i, "K_IO": 0.0}
    expected |= {"K_PP": 1.0 + lift**2 / 2.0, "K_OO": 0.0, "K_OQ": a_i**2, "delta_O": 1.0}
    for symbol, value in expected.items():
        assert means[symbol] == pytest.approx(value, rel=1e-14, abs=1e-15), symbol


def test_earth_rate_cross_term_matches_literature():
    """The term is 3.28e-5 of a at pi rad/s and 45 deg; its sign follows the sense."""
    site = Site(9.8, math.pi / 4.0)
    ahead, back = (
        station_means(make_arm("inward", "up", rate=rate, radius=1.0), site, ["K_I"])[0]
        for rate in (math.pi, -math.pi)
    )
    assert (ahead - back) / (ahead + back) == pytest.approx(3.28e-5, rel=2e-3)


def test_double_turntable_means_match_closed_form():
    rate, radius, site = 3.0, 2.5, Site(9.8, 0.7, earth_rate=0.0)
    means = station_means(Station("counter-rotating", QX, rate=rate, radius=radius), site, SYMBOLS)
    size = radius * rate**2 / site.gravity
    mean_by_symbol = dict(zip(SYMBOLS, means, strict=True))
    assert mean_by_symbol["K_II"] == pytest.approx(size**2 / 2.0, rel=1e-14)
    assert mean_by_symbol["K_OO"] == pytest.approx(size**2 / 2.0, rel=1e-14)
    assert mean_by_symbol["K_PP"] == pytest.approx(1.0, rel=1e-14)
    for symbol in ("K_I", "K_III", "K_IO"):
        assert abs(mean_by_symbol[symbol]) < 1e-15 * size**3


def test_stretch_lengthens_radius_in_proportion_to_acceleration():
    site = Site(9.80665, 0.0, earth_rate=0.0)
    rate, stretch = 9.9, 4.6e-9
    plain, longer = (
        station_means(make_arm("inward", "up", rate=rate, radius=1.0, stretch=s), site, ["K_I"])[0]
        for s in (0.0, stretch)
    )
    assert longer / plain - 1.0 == pytest.approx(stretch * rate**2, rel=1e-6)


@pytest.mark.parametrize(("inputs", "sign"), [("inward", 1.0), ("outward", -1.0)])
def test_droop_projects_gravity_on_radial_input_axis(inputs, sign):
    site = Site(9.8, 0.0, earth_rate=0.0)
    rate, droop = 9.9, 1e-8
    plain, drooped = (
        station_means(make_arm(inputs, "forward", rate=rate, radius=1.0, droop=d), site, ["K_I"])[0]
        for d in (0.0, droop)
    )
    # The outer end goes down, so an axis that points inwards looks up and feels gravity.
    assert drooped - plain == pytest.approx(sign * droop * rate**2, rel=1e-4)


def test_small_rotation_is_right_handed():
    site = Site(9.8, 0.0)
    mounting = Mounting.from_axes("north", "west")
    turned = Station("static", mounting, turn=(1e-3, 0.0, 0.0))
    # About east, north turns up.
    assert station_means(turned, site, ["K_I"])[0] == pytest.approx(math.sin(1e-3), rel=1e-12)


def test_k_f_and_squares_are_collinear_at_rest():
    """a_I^2 + a_P^2 + a_O^2 = 1: ten terms of second degree have rank nine at 1 g."""
    rng = np.random.default_rng(7)
    terms = ["K_F", "K_I", "delta_O", "delta_P", "K_II", "K_PP", "K_OO", "K_IP", "K_IO", "K_PO"]
    rows = []
    for _ in range(48):
        first, second = rng.normal(size=(2, 3))
        i = direction(list(first))
        p = direction(list(second - (second @ i) * i))
        rows.append(
            station_means(Station("static", Mounting.from_axes(list(i), list(p))), SITE, terms)
        )
    _, sizes, directions = np.linalg.svd(np.array(rows))
    assert sizes[-2] > 0.1
    assert sizes[-1] < 1e-13
    null = directions[-1] / directions[-1][0]
    expected = [
        1.0 if t == "K_F" else -1.0 if t in ("K_II", "K_PP", "K_OO") else 0.0 for t in terms
    ]
    np.testing.assert_allclose(null, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("positions", "terms", "expected"),
    [
        (12, ["1", "c", "s", "cc", "cs"], [0.5, 0.408248, 0.408248, 0.816497, 0.816497]),
        (
            24,
            ["1", "c", "s", "cc", "cs", "ccc"],
            [0.353553, 0.912871, 0.288675, 0.577350, 0.577350, 1.154701],
        ),
    ],
)
def test_equal_angle_tumble_has_textbook_uncertainties(positions, terms, expected):
    """IEEE Std 1293's multi-position tumble, u over the sigma of one reading."""
    symbols = {"1": "K_F", "c": "K_I", "s": "delta_O", "cc": "K_II", "cs": "K_IP", "ccc": "K_III"}
    rows = []
    for angle in np.arange(positions) * 2.0 * np.pi / positions:
        up_along_i, up_along_p = math.cos(angle), math.sin(angle)
        # The input axis leaves up by the angle, about north, which stays the output axis.
        i = [-up_along_p, 0.0, up_along_i]
        p = [up_along_i, 0.0, up_along_p]
        station = Station("static", Mounting.from_axes(i, p))
        rows.append(station_means(station, SITE, [symbols[t] for t in terms]))
    covariance = np.linalg.inv(np.array(rows).T @ np.array(rows))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), expected, rtol=0, atol=6e-7)


# An unweighted cubic fit to inputs that are wrong: figures of the literature to the digits given.

INPUTS = np.array([s * a for s in (1, -1) for a in (1.0, 2.0, 5.0, 10.0, 15.0, 20.0)])
TRUE = (2e-3, 1.0005, 15e-6, 2e-6)


def fit_cubic(claimed, actual):
    output = np.polynomial.polynomial.polyval(actual, TRUE)
    return np.polynomial.polynomial.polyfit(claimed, output, 3)


def test_cubic_of_wrong_input_matches_literature():
    np.testing.assert_allclose(
        fit_cubic(INPUTS, INPUTS + 1e-4),
        [2.1000500002e-3, 1.000500003, 1.50006e-5, 2e-6],
        rtol=1e-10,
    )
    np.testing.assert_allclose(
        fit_cubic(INPUTS, INPUTS * (1 + 1e-5)),
        [2e-3, 1.000510005, 1.50003e-5, 2.00006e-6],
        rtol=1e-9,
    )


@pytest.mark.parametrize(
    ("inputs", "expected"),
    [
        (INPUTS, ["1.99999947e-3", "1.00050029", "1.50000267e-5", "2.00155452e-6"]),
        (np.arange(1.0, 21.0), ["1.99999901e-3", "1.0005000", "1.5044977e-5", "2.0000127e-6"]),
    ],
    ids=["both sides", "one side"],
)
def test_cubic_of_stretching_arm_matches_literature(inputs, expected):
    """The radius grows by a fraction of 4.6e-9 per m/s^2."""
    site, stretch = Site(9.80665, 0.0, earth_rate=0.0), 4.6e-9
    actual = []
    for a in inputs:
        side = "inward" if a > 0 else "outward"
        rate = math.sqrt(abs(a) * site.gravity)
        station = make_arm(side, "up", rate=rate, radius=1.0, stretch=stretch)
        actual.append(station_means(station, site, ["K_I"])[0])
    for coefficient, printed in zip(fit_cubic(inputs, np.array(actual)), expected, strict=True):
        half_a_digit = 0.5 * float(Decimal((0, (1,), Decimal(printed).as_tuple().exponent)))
        assert abs(coefficient - float(printed)) <= half_a_digit


@pytest.mark.parametrize("start", [0.0, 0.3])
def test_means_of_kinked_products_are_exact(start):
    """A tilted axis adds gravity to the wave: |c + a cos x| has a closed mean."""
    turned = Mounting.from_axes(
        [math.cos(start), math.sin(start), 0.1], [math.sin(start), -math.cos(start), 0.0]
    )
    station = Station("counter-rotating", turned, rate=3.0, radius=2.5)
    site = replace(SITE, earth_rate=0.0)
    level = math.hypot(*turned.input_axis[:2])
    wave, mean = level * 2.5 * 9.0 / site.gravity, float(turned.input_axis[2])
    crossing = math.acos(-mean / wave)
    size = 2.0 * (mean * (crossing - math.pi / 2.0) + wave * math.sin(crossing)) / math.pi
    # The sign grows linearly over +-1 mg, and has the mean of a jump in the middle of it.
    sign = 2.0 * crossing / math.pi - 1.0
    means = station_means(station, site, ["K_I_asym", "K_0_asym"])
    assert means[0] == pytest.approx(0.5 * size, rel=1e-12)
    assert means[1] == pytest.approx(0.5 * sign, abs=1e-9)


def test_arm_rotates_instrument_about_sensor_axes():
    halfway = Mounting.from_axes([1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])
    spun = station_means(Station("arm", halfway, rate=-4.0, radius=0.5), SITE, ["K_spin"])
    assert spun[0] == pytest.approx(8.0, rel=1e-14)
    drooped = make_arm("outward", "up", rate=4.0, radius=0.5, droop=1e-4)
    turn = 1e-4 * 16.0  # about forward: the outer end goes down
    expected = -math.sin(turn) * math.cos(turn) * 16.0
    assert station_means(drooped, SITE, ["K_spin"])[0] == pytest.approx(expected, rel=1e-12)
    at_rest = Station("static", Mounting.from_axes([1, 0, 1], [-1, 0, 1]))
    turntable = Station("counter-rotating", at_rest.mounting, rate=4.0, radius=0.5)
    for station in (at_rest, turntable):
        assert not station_means(station, SITE, ["K_spin", "K_ang"]).any()


def test_first_harmonic_of_table_adds_mean_force():
    """1 arcsec with a phase of 0.3 rad at 2.5 m and 1 rev/s: -2.33061e-5 g along the axis."""
    eps, phase = math.pi / 648000.0, 0.3
    site = Site(9.80665, 0.8, earth_rate=0.0)
    wave = ((1, eps * math.sin(phase), eps * math.cos(phase)),)
    station = Station("counter-rotating", QX, rate=2.0 * math.pi, radius=2.5)
    moved = station_means(replace(station, table=wave), site, ["K_I"])
    force = moved - station_means(station, site, ["K_I"])
    expected = -eps * 2.5 * (2.0 * math.pi) ** 2 * math.cos(phase) / 2.0 / site.gravity
    assert force[0] == pytest.approx(expected, rel=1e-5)
    assert force[0] == pytest.approx(-2.33061e-5, rel=5e-5)
    # Twice a turn leaves nothing in the mean, to first order.
    twice = replace(station, table=((2, eps, eps),))
    assert abs(station_means(twice, site, ["K_I"])[0]) < 10.0 * eps**2


@pytest.mark.parametrize("observable", ["velocity", "specific_force"])
def test_strapdown_record_has_mean_force_of_table_harmonic(observable):
    """The mean over whole revolutions equals the force on readings."""
    eps, phase, rate = math.pi / 648000.0, 0.3, 2.0 * math.pi
    trajectory = Trajectory(Spindle(rate), 2.5, Site(9.80665, 0.8, earth_rate=0.0))
    symbols = ["table.harmonic.1.cos", "table.harmonic.1.sin"]
    times = np.linspace(0.0, 3.0, 3001)
    shown = columns(trajectory, QX, symbols, times, observable)
    shown = shown @ [eps * math.sin(phase), eps * math.cos(phase)]
    mean = shown[-1] / 3.0 if observable == "velocity" else shown[:-1].mean()
    assert mean / 9.80665 == pytest.approx(-2.33061e-5, rel=5e-5)
