"""Coefficients in SI units, with the part of u that an uncertain gravity leaves."""

from __future__ import annotations

import math

from counterspin.frozen import frozen
from counterspin.reports.numbers import format_compact
from counterspin.units import SiUnit, instrument_unit_in_si, si_unit


@frozen
class StatedGravity:
    """The gravity in whose units a coefficient is."""

    #: m/s^2, and its standard uncertainty.
    value: float
    u: float = 0.0
    #: What the coefficient moves by per m/s^2 of the g assumed, in its own unit.
    sensitivity: float = 0.0


@frozen
class SiEstimate:
    """One coefficient in SI units."""

    #: Estimate, standard uncertainty and their unit.
    value: float
    u: float
    unit: SiUnit
    dof: float | None  #: Effective degrees of freedom of u; None is infinite.
    u_without_g: float  #: u if g were exact.
    #: What one standard uncertainty of g moves the estimate by, signed: nothing where it cancels.
    shift: float
    shift_kept: float  #: The same for the number in g-units, converted with an exact g.

    def __str__(self) -> str:
        """Return such as ``2.75772(37)e-6 m^-1 s^2``."""
        return f"{format_compact(self.value, self.u)} {self.unit.plain_text}"


def convert_to_si(
    value: float, u: float, unit: str, dof: float | None, gravity: StatedGravity
) -> SiEstimate:
    """Return a coefficient in SI units.

    The SI value is K g^n. If an error of the g assumed moves K by s per m/s^2, it moves the SI
    value by g^n (s + n K/g), which takes the place of g^n s in the uncertainty.

    value, u, unit, dof: Of the coefficient, in g-units.
    gravity: The g of the unit.
    """
    return _convert_estimate(value, u, (1.0, *si_unit(unit)), dof, gravity)


def convert_instrument_unit(
    value: float, u: float, unit: str, dof: float | None, gravity: StatedGravity
) -> SiEstimate:
    """Return in SI units what is in an instrument's own unit, or in that over g.

    Arguments as in `convert_to_si`; ValueError if the unit has no expression in SI.
    """
    return _convert_estimate(value, u, instrument_unit_in_si(unit), dof, gravity)


def _convert_estimate(
    value: float,
    u: float,
    unit: tuple[float, SiUnit, int],
    dof: float | None,
    gravity: StatedGravity,
) -> SiEstimate:
    factor, symbol, power = unit
    g = gravity.value
    scale = factor * g**power
    si_value, si_u = value * scale, u * scale
    if gravity.u == 0.0:
        return SiEstimate(si_value, si_u, symbol, dof, si_u, 0.0, 0.0)
    shift_kept = gravity.sensitivity * gravity.u * scale
    shift = shift_kept + power * si_value / g * gravity.u
    u_without_g = math.sqrt(max(si_u**2 - shift_kept**2, 0.0))
    combined_u = math.hypot(u_without_g, shift)
    # What g adds or takes away has no degrees of freedom (GUM G.4.1).
    effective_dof = None if dof is None else dof * (combined_u / si_u) ** 4
    return SiEstimate(si_value, combined_u, symbol, effective_dof, u_without_g, shift, shift_kept)
