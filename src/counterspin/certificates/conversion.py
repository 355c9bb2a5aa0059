"""The coefficients of a result in SI units, as a certificate states them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Final

from counterspin.calibration.notebook.si_estimate import SiEstimate, own_estimate, si_estimate
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient, Correlation
from counterspin.certificates import wording


def in_si(result: Result, name: str) -> dict[str, SiEstimate]:
    """Return the determined coefficients of an accelerometer in SI units."""
    estimates = {}
    for symbol, c in result.accelerometers[name].coefficients.items():
        if wording.is_determined(c):
            assert c.value is not None
            assert c.u is not None
            gravity = result.gravity_of(name, symbol)
            estimates[symbol] = si_estimate(c.value, c.u, c.unit, c.dof, gravity)
    return estimates


#: What is stated in the unit of the readings too -> the coefficient that it is a multiple of.
OUTPUT: Final = {"bias": "K_F", "scale_factor": "K_I"}


def output_in_si(result: Result, name: str) -> dict[str, SiEstimate]:
    """Return bias and scale factor in the SI unit of an accelerometer's readings.

    Those are left out whose unit has no expression in SI.
    """
    accelerometer = result.accelerometers[name]
    estimates = {}
    for key, c in accelerometer.output.items():
        symbol = OUTPUT[key]
        own = accelerometer.coefficients.get(symbol)
        if own is None or not wording.is_determined(c):
            continue
        assert c.value is not None
        assert c.u is not None
        gravity = result.gravity_of(name, symbol)
        # Both moved by g alike: one is the other times the nominal sensitivity, which is exact.
        if accelerometer.nominal is not None:
            times = accelerometer.nominal.sensitivity
        else:
            times = c.value / own.value if own.value else c.u / (own.u or math.inf)
        moved = replace(gravity, sensitivity=gravity.sensitivity * times)
        with suppress(ValueError):
            estimates[key] = own_estimate(c.value, c.u, c.unit, c.dof, moved)
    return estimates


def with_exact_g(coefficients: Mapping[str, Coefficient], gravity: float) -> dict[str, SiEstimate]:
    """Return coefficients in SI units, g (m/s^2) being exact."""
    return {
        symbol: c.to_si(gravity) for symbol, c in coefficients.items() if wording.is_determined(c)
    }


def covariance(
    correlation: Correlation, estimates: Mapping[str, SiEstimate], one: str, other: str
) -> float:
    """Return the covariance of two coefficients in SI units.

    correlation: Theirs in g-units.
    """
    first, second = estimates[one], estimates[other]
    if one == other:
        # The correlation is 1, but perhaps not in its last digit.
        return first.u * first.u
    terms, matrix = correlation.terms, correlation.matrix
    # The product must not depend on the order: the matrix is symmetric to the last digit.
    places = sorted((terms.index(one), terms.index(other)))
    u = [math.hypot(estimate.u_without_g, estimate.shift_kept) for estimate in (first, second)]
    together = matrix[places[1]][places[0]] * (u[0] * u[1])
    return together + first.shift * second.shift - first.shift_kept * second.shift_kept
