"""Shifts of coefficients compared with their uncertainties."""

from __future__ import annotations

from collections.abc import Sequence

from counterspin.arrays import Array
from counterspin.calibration.view import AccelerometerView
from counterspin.inference.joint.unknowns import unit_of
from counterspin.reports.numbers import field_unit, format_number


def most_moved(
    view: AccelerometerView, places: Sequence[int], moved: Array
) -> tuple[str, float, float]:
    """Return which coefficient moves most over its u, by how much, and by how many of its u.

    places: Of unknowns that do not count.
    moved: By how much each unknown moves, shape (p,).
    """
    found = [
        (symbol, float(moved[place]), abs(float(moved[place])) / u)
        for symbol, place in view.places.items()
        if view.assessment.determined[f"{view.name}.{symbol}"]
        and place not in places
        and (u := float(view.fit.solution.u[place])) > 0.0
    ]
    return max(found, key=lambda one: one[2], default=("", 0.0, 0.0))


def shown_size(symbol: str, size: float, digits: int = 2) -> str:
    """Return a size of a term in the unit in which it is shown."""
    unit, factor = field_unit(unit_of(symbol))
    if unit == "1":
        unit, factor = "ppm", 1e6
    return f"{format_number(size * factor, digits)} {unit}"
