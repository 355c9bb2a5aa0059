"""Acceleration applied by an arm centrifuge, its sensitivities and its distribution.

a = R (1 + s c) w^2 cos(beta) cos(lambda) + g sin(lambda) + 2 w Omega R sin(L), with c = R w^2 and
lambda = lambda_0 + d w^2 (IEEE Std 836, Annex B; Ling et al., Opt. Precis. Eng. 23 (2015) 2306).

The input axis points inward along the arm. The result is the mean over a revolution. The tilt of
the spindle axis changes the acceleration only within a revolution.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from counterspin.acceleration_standard.result import MonteCarloCheck
from counterspin.arrays import Array
from counterspin.campaign.distribution import draw_standardized
from counterspin.campaign.quantity import NORMAL, InputDistribution
from counterspin.inference.distributions import COVERAGE, expanded_uncertainty, numerical_tolerance
from counterspin.physics.motion import EARTH_RATE

#: Sources of uncertainty -> SI unit.
UNITS: Final = {
    "radius": "m",
    "stretch": "s^2/m",
    "elevation": "rad",
    "azimuth": "rad",
    "droop": "rad s^2",
    "rate": "1",
    "clock": "1",
    "gravity": "m/s^2",
    "latitude": "rad",
}


def applied_acceleration(sources: Mapping[str, Array | float], rate: float) -> Array | float:
    """Return the mean applied acceleration, m/s^2, shape of the sources.

    sources: Value of each source in `UNITS`. `rate` and `clock` are relative errors of the rate.
    rate: Nominal rate, rad/s; negative in the clockwise sense.
    """
    radius, gravity = sources["radius"], sources["gravity"]
    true_rate = rate * (1.0 + sources["rate"] + sources["clock"])
    squared_rate = true_rate * true_rate
    centripetal = radius * squared_rate
    elevation = sources["elevation"] + sources["droop"] * squared_rate
    acceleration: Array | float = (
        centripetal
        * (1.0 + sources["stretch"] * centripetal)
        * np.cos(sources["azimuth"])
        * np.cos(elevation)
        + gravity * np.sin(elevation)
        + 2.0 * true_rate * EARTH_RATE * radius * np.sin(sources["latitude"])
    )
    return acceleration


def sensitivities(sources: Mapping[str, float], rate: float) -> dict[str, float]:
    """Return the partial derivative of the applied acceleration with respect to each source."""
    radius, gravity, stretch = sources["radius"], sources["gravity"], sources["stretch"]
    true_rate = rate * (1.0 + sources["rate"] + sources["clock"])
    squared_rate = true_rate * true_rate
    centripetal = radius * squared_rate
    stretched_centripetal = centripetal * (1.0 + stretch * centripetal)
    elevation, azimuth = sources["elevation"] + sources["droop"] * squared_rate, sources["azimuth"]
    alignment_factor = math.cos(azimuth) * math.cos(elevation)
    earth_rate_term = 2.0 * true_rate * EARTH_RATE * radius
    centripetal_derivative = (1.0 + 2.0 * stretch * centripetal) * alignment_factor
    elevation_derivative = gravity * math.cos(elevation) - stretched_centripetal * math.cos(
        azimuth
    ) * math.sin(elevation)
    rate_derivative = (
        2.0 * centripetal * centripetal_derivative
        + 2.0 * sources["droop"] * squared_rate * elevation_derivative
        + earth_rate_term * math.sin(sources["latitude"])
    ) * (rate / true_rate)
    return {
        "radius": squared_rate * centripetal_derivative
        + earth_rate_term * math.sin(sources["latitude"]) / radius,
        "stretch": centripetal**2 * alignment_factor,
        "elevation": elevation_derivative,
        "azimuth": 0.0 - stretched_centripetal * math.sin(azimuth) * math.cos(elevation),
        "droop": squared_rate * elevation_derivative,
        "rate": rate_derivative,
        "clock": rate_derivative,
        "gravity": math.sin(elevation),
        "latitude": earth_rate_term * math.cos(sources["latitude"]),
    }


def draw_distributions(
    values: Mapping[str, float],
    u: Mapping[str, float],
    rates: list[float],
    draws: int,
    seed: int,
    distributions: Mapping[str, InputDistribution],
) -> list[MonteCarloCheck]:
    """Draw all sources from their distributions; return the distribution at each rate.

    If all sources are normal, the linear model is evaluated with the same draws. Its exact
    quantiles are known, so the difference of the quantiles of both models has a much smaller
    sampling error than either.

    distributions: Source -> distribution that is not normal.
    """
    rng = np.random.default_rng(seed)
    errors = {
        name: u[name] * draw_standardized(distributions.get(name, NORMAL), draws, rng)
        if u[name]
        else np.zeros(1)
        for name in UNITS
    }
    drawn_values = {name: values[name] + error for name, error in errors.items()}
    checks = []
    for rate in rates:
        derivatives = sensitivities(values, rate)
        estimate = float(applied_acceleration(values, rate))
        linear_errors = sum(
            (derivatives[name] * error for name, error in errors.items() if u[name]),
            np.zeros(draws),
        )
        exact_errors = np.broadcast_to(applied_acceleration(drawn_values, rate), draws) - estimate
        u_linear = math.sqrt(sum((derivatives[name] * u[name]) ** 2 for name in UNITS))
        half_width = expanded_uncertainty(u_linear, None, COVERAGE)
        tail_probability = 0.5 * (1.0 - COVERAGE)
        endpoints = np.array([-half_width, half_width])
        if not distributions:
            endpoints = np.quantile(linear_errors, (tail_probability, 1.0 - tail_probability))
        endpoint_shifts = (
            np.quantile(exact_errors, (tail_probability, 1.0 - tail_probability)) - endpoints
        )
        max_shift, tolerance = float(np.max(np.abs(endpoint_shifts))), numerical_tolerance(u_linear)
        checks.append(
            MonteCarloCheck(
                mean=estimate + float(np.mean(exact_errors)),
                u=float(np.std(exact_errors, ddof=1)),
                low=estimate - half_width + float(endpoint_shifts[0]),
                high=estimate + half_width + float(endpoint_shifts[1]),
                distance=max_shift,
                tolerance=tolerance,
                validated=max_shift <= tolerance,
            )
        )
    return checks
