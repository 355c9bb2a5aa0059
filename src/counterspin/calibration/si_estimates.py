"""Coefficients in SI units, with the contribution of an uncertain gravity to u."""

from __future__ import annotations

import math

from counterspin.frozen import frozen
from counterspin.reports.numbers import format_compact
from counterspin.units import SiUnit, instrument_unit_in_si, si_unit


@frozen
class StatedGravity:
    """The gravity that defines the unit of a coefficient."""

    #: Value and standard uncertainty, m/s^2.
    value: float
    u: float = 0.0
    #: Sensitivity of the coefficient to the assumed g, in its unit per m/s^2.
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
    #: Signed shift of the estimate for one standard uncertainty of g; 0 if the effects cancel.
    shift: float
    shift_kept: float  #: The same shift without the effect of g on the conversion.

    def __str__(self) -> str:
        """Return such as ``2.75772(37)e-6 m^-1 s^2``."""
        return f"{format_compact(self.value, self.u)} {self.unit.plain_text}"


def convert_to_si(
    value: float, u: float, unit: str, dof: float | None, gravity: StatedGravity
) -> SiEstimate:
    """Return a coefficient in SI units.

    The SI value is K g^n. If K has the sensitivity s to the assumed g, the SI value has the
    sensitivity g^n (s + n K/g), which replaces g^n s in the uncertainty.

    value, u, unit, dof: Coefficient in g-units, with its effective degrees of freedom.
    gravity: The g of the unit.
    """
    return _convert_estimate(value, u, (1.0, *si_unit(unit)), dof, gravity)


def convert_instrument_unit(
    value: float, u: float, unit: str, dof: float | None, gravity: StatedGravity
) -> SiEstimate:
    """Convert a value in the unit of an instrument, or in this unit per g, to SI units.

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
    # The contribution of g has infinite degrees of freedom (GUM G.4.1).
    effective_dof = None if dof is None else dof * (combined_u / si_u) ** 4
    return SiEstimate(si_value, combined_u, symbol, effective_dof, u_without_g, shift, shift_kept)
