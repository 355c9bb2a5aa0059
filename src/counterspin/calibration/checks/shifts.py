"""Shifts of coefficients compared with their uncertainties."""

from __future__ import annotations

from collections.abc import Sequence

from counterspin.arrays import Array
from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.inference.joint.unknowns import unit_of
from counterspin.reports.numbers import find_display_unit, format_number


def largest_shift(
    view: AccelerometerView, excluded_indices: Sequence[int], shifts: Array
) -> tuple[str, float, float]:
    """Return the coefficient with the largest shift over u, the shift, and the shift over u.

    excluded_indices: Indices of unknowns to ignore.
    shifts: Shift of each unknown, shape (p,).
    """
    candidates = [
        (symbol, float(shifts[index]), abs(float(shifts[index])) / u)
        for symbol, index in view.indices.items()
        if view.assessment.determined[f"{view.name}.{symbol}"]
        and index not in excluded_indices
        and (u := float(view.fit.solution.u[index])) > 0.0
    ]
    return max(candidates, key=lambda candidate: candidate[2], default=("", 0.0, 0.0))


def format_magnitude(symbol: str, magnitude: float, digits: int = 2) -> str:
    """Return a magnitude of a term as text in the unit of the field."""
    unit, factor = find_display_unit(unit_of(symbol))
    if unit == "1":
        unit, factor = "ppm", 1e6
    return f"{format_number(magnitude * factor, digits)} {unit}"
