"""The coefficients of a result in SI units, with what the uncertainty of g does there.

In g-units a coefficient is known less well where g is: K_F of a displacement record is its
acceleration over g. In SI units the same g multiplies it again, and most of that part cancels.

- `in_si`: the determined coefficients of an accelerometer
- `with_exact_g`: of numbers whose g is exact
- `SiEstimate`: one of them; `covariance`: of two
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient
from counterspin.certificates import wording
from counterspin.certificates.units import SiUnit, si_unit, to_si
from counterspin.physics.accelerometer import TERMS


@dataclass(frozen=True)
class SiEstimate:
    """One coefficient in SI units.

    Attributes
    ----------
    value, u, unit
        Estimate, standard uncertainty and their unit.
    dof
        Effective degrees of freedom of u; None is infinite.
    u_without_g
        u if g were exact.
    shift
        What one standard uncertainty of g moves the estimate by, signed: nothing where it cancels.
    shift_kept
        The same for the number in g-units, converted with an exact g.
    """

    value: float
    u: float
    unit: SiUnit
    dof: float | None
    u_without_g: float
    shift: float
    shift_kept: float


def in_si(result: Result, name: str) -> dict[str, SiEstimate]:
    """Return the determined coefficients of an accelerometer in SI units.

    The SI value is K g^n. If an error of the g assumed moves K by s per m/s^2, it moves the SI
    value by g^n (s + n K/g), which takes the place of g^n s in the uncertainty.

    Parameters
    ----------
    result
        The result.
    name
        The accelerometer.
    """
    gravity, u_gravity = result.inputs.gravity, result.inputs.u_gravity
    accelerometer = result.accelerometers[name]
    estimates = with_exact_g(accelerometer.coefficients, gravity)
    if u_gravity == 0.0:
        return estimates
    for symbol, exact in estimates.items():
        c = accelerometer.coefficients[symbol]
        kept = to_si(_to_gravity(result, accelerometer, symbol, c) * u_gravity, c.unit, gravity)
        shift = kept + si_unit(c.unit)[1] * exact.value / gravity * u_gravity
        without = math.sqrt(max(exact.u**2 - kept**2, 0.0))
        u = math.hypot(without, shift)
        # What g adds or takes away has no degrees of freedom (GUM G.4.1).
        dof = None if c.dof is None else c.dof * (u / exact.u) ** 4
        estimates[symbol] = replace(
            exact, u=u, dof=dof, u_without_g=without, shift=shift, shift_kept=kept
        )
    return estimates


def with_exact_g(coefficients: Mapping[str, Coefficient], gravity: float) -> dict[str, SiEstimate]:
    """Return coefficients in SI units, g (m/s^2) being exact."""
    estimates = {}
    for symbol, c in coefficients.items():
        if wording.is_determined(c):
            assert c.value is not None
            assert c.u is not None
            value, u = (to_si(number, c.unit, gravity) for number in (c.value, c.u))
            estimates[symbol] = SiEstimate(value, u, si_unit(c.unit)[0], c.dof, u, 0.0, 0.0)
    return estimates


def _to_gravity(
    result: Result, accelerometer: AccelerometerResult, symbol: str, c: Coefficient
) -> float:
    """Return what the coefficient moves by per m/s^2 of the g assumed."""
    if result.method == "two-stage" and symbol in TERMS and c.value is not None:
        # b2 of a coefficient of degree n goes with g^(1-n).
        return (len(TERMS[symbol].factors) - 1) * c.value / result.inputs.gravity
    for line in accelerometer.budget.get(symbol, ()):
        if line.source == "site.gravity (input)" and line.sensitivity is not None:
            return line.sensitivity
    return 0.0


def covariance(
    accelerometer: AccelerometerResult, estimates: Mapping[str, SiEstimate], one: str, other: str
) -> float:
    """Return the covariance of two coefficients in SI units.

    Parameters
    ----------
    accelerometer
        Whose they are; its correlations are of the g-units.
    estimates
        Of `in_si`.
    one, other
        Their symbols, both among the correlation's terms.
    """
    first, second = estimates[one], estimates[other]
    if one == other:
        # The correlation is 1, but perhaps not in its last digit.
        return first.u * first.u
    assert accelerometer.correlation is not None
    terms, matrix = accelerometer.correlation.terms, accelerometer.correlation.matrix
    # The product must not depend on the order: the matrix is symmetric to the last digit.
    places = sorted((terms.index(one), terms.index(other)))
    u = [math.hypot(estimate.u_without_g, estimate.shift_kept) for estimate in (first, second)]
    together = matrix[places[1]][places[0]] * (u[0] * u[1])
    return together + first.shift * second.shift - first.shift_kept * second.shift_kept
