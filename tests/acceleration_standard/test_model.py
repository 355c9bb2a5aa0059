"""The applied acceleration against the station model, complex steps and Monte Carlo values."""

import math

import numpy as np
import pytest
from stations import Station

from counterspin.acceleration_standard.model import (
    UNITS,
    applied_acceleration,
    draw_distributions,
    sensitivities,
)
from counterspin.campaign.quantity import InputDistribution
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.motion import Site
from counterspin.physics.station import FRAMES

ARCSEC = math.radians(1.0) / 3600.0
G = 9.80665

#: An arm of 1 m: relative u at 1, 10, 50 and 100 g by an independent Monte Carlo of 1e6 draws.
U = dict.fromkeys(UNITS, 0.0) | {
    "radius": 1e-6,
    "stretch": 5e-9,
    "elevation": 2.0 * ARCSEC,
    "azimuth": 2.0 * ARCSEC,
    "droop": 1e-9,
    "rate": 3e-7,
}
NOMINAL = dict.fromkeys(UNITS, 0.0) | {"radius": 1.0, "gravity": G, "latitude": 0.8}
RELATIVE = {1.0: 9.77e-6, 10.0: 1.59e-6, 50.0: 2.72e-6, 100.0: 5.03e-6}

#: Sources far from nominal, so that all derivatives are nonzero.
IMPERFECT = {
    "radius": 0.9,
    "stretch": 3e-5,
    "elevation": 0.05,
    "azimuth": -0.04,
    "droop": 2e-4,
    "rate": 2e-3,
    "clock": -1e-3,
    "gravity": 9.81,
    "latitude": -0.6,
}


@pytest.mark.parametrize("level", RELATIVE)
def test_relative_uncertainties_of_1_m_arm(level):
    rate = math.sqrt(level * G)
    slopes = sensitivities(NOMINAL, rate)
    acceleration = applied_acceleration(NOMINAL, rate)
    u = math.hypot(*(slopes[name] * U[name] for name in UNITS))
    assert u / acceleration == pytest.approx(RELATIVE[level], rel=5e-3)
    # The standard deviation of 4e5 draws has a relative sampling error of 1.1e-3.
    (drawn,) = draw_distributions(NOMINAL, U, [rate], 400_000, 5, {})
    assert drawn.u / acceleration == pytest.approx(RELATIVE[level], rel=5e-3)
    assert drawn.distance < drawn.tolerance


@pytest.mark.parametrize("rate", [7.0, -3.0])
def test_sensitivities_match_complex_step_derivatives(rate):
    slopes = sensitivities(IMPERFECT, rate)
    for name, value in IMPERFECT.items():
        moved = applied_acceleration(IMPERFECT | {name: value + 1e-30j}, rate)
        assert slopes[name] == pytest.approx(np.imag(moved) / 1e-30, rel=1e-12)


@pytest.mark.parametrize("rate", [7.0, -3.0])
def test_acceleration_matches_mean_force_of_station(rate):
    """The station adds up the specific force of the exact kinematics over a revolution."""
    values = IMPERFECT | {"stretch": 1e-6, "rate": 0.0, "clock": 0.0, "azimuth": 0.0}
    mounting = Mounting.from_axes(FRAMES["arm"]["inward"], FRAMES["arm"]["up"])
    station = Station(
        "arm",
        mounting,
        rate=rate,
        radius=values["radius"],
        stretch=values["stretch"],
        droop=values["droop"],
        turn=(0.0, values["elevation"], 0.0),
    )
    site = Site(values["gravity"], values["latitude"])
    mean = station.indicated(site, {}) * values["gravity"]
    # The Earth-rate term is not projected by the elevation, and the stretch changes its radius.
    elevation = values["elevation"] + values["droop"] * rate**2
    left_out = 2.0 * abs(rate) * 7.3e-5 * (0.5 * elevation**2 + 1e-4)
    assert applied_acceleration(values, rate) == pytest.approx(mean, abs=left_out)


def test_large_misalignment_does_not_validate_gum_interval():
    """The mean of cos(beta) is exp(-u^2/2); the first order has no contribution of beta."""
    u = U | {"azimuth": 0.02}
    (drawn,) = draw_distributions(NOMINAL, u, [10.0], 200_000, 3, {})
    acceleration = applied_acceleration(NOMINAL, 10.0)
    shift = acceleration * (math.exp(-0.5 * 0.02**2) - 1.0)
    # The variance of beta^2/2 is u^4/2.
    sampling = acceleration * 0.02**2 / math.sqrt(2.0) / math.sqrt(200_000)
    assert drawn.mean - acceleration == pytest.approx(shift, abs=4.0 * sampling)
    assert drawn.distance > drawn.tolerance


def test_dominant_rectangular_radius_has_rectangular_interval():
    """The 95 % half-width of a rectangular distribution is 0.95 a; the GUM gives 1.13 a."""
    u = dict.fromkeys(UNITS, 0.0) | {"radius": 1e-5}
    limits = {"radius": InputDistribution("rectangular")}
    (drawn,) = draw_distributions(NOMINAL, u, [10.0], 200_000, 3, limits)
    width = (drawn.high - drawn.low) / applied_acceleration(NOMINAL, 10.0)
    assert width == pytest.approx(2.0 * 0.95 * math.sqrt(3.0) * 1e-5, rel=0.01)
    assert not drawn.validated
