"""Priors with a distribution (GUM 4.3, JCGM 101, 6.4), as tables in `[model.priors]`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final, Literal

from counterspin.campaign.field_types import exact
from counterspin.campaign.quantity import Quantity, parse
from counterspin.frozen import frozen

Shape = Literal["normal", "t", "rectangular", "triangular", "arcsine"]

#: Half-width over the standard deviation of the distributions with limits.
_LIMITED: Final[Mapping[Shape, float]] = {
    "rectangular": math.sqrt(3.0),
    "triangular": math.sqrt(6.0),
    "arcsine": math.sqrt(2.0),
}

#: The keys with which a value is given, and what they mean.
_FORMS: Final = (
    {"value", "u"},
    {"value", "u", "dof"},
    {"value", "U", "k"},
    {"value", "half_width", "distribution"},
)

_KEYS: Final = set[object]().union(*_FORMS)

#: Fewest degrees of freedom of a stated uncertainty.
_MIN_DOF: Final = 1.0

_ADVICE: Final = (
    "give value with u, with u and dof, with U and k, or with half_width and distribution "
    "(rectangular, triangular or arcsine)"
)


@frozen
class InputDistribution:
    """Shape of the distribution of an input about its value."""

    shape: Shape = "normal"
    dof: float = math.inf  #: Degrees of freedom of Student's t; infinite of all others.


def is_prior_table(value: object) -> bool:
    """Return whether a value is a prior in the form of a table; no term has a name of its keys."""
    return isinstance(value, Mapping) and not _KEYS.isdisjoint(value)


def parse_prior(
    written: object, unit: str, *, gravity: float | None
) -> tuple[Quantity, InputDistribution]:
    """Return a prior with its standard uncertainty, and the shape of its distribution.

    written: A quantity with ±, which is normal, or a table.
    unit: Of the term.

    Raises ValueError if it is neither.
    """
    if not isinstance(written, Mapping):
        return parse(written, unit, gravity=gravity), InputDistribution()
    if set(written) not in _FORMS:
        raise ValueError(f"has {', '.join(map(str, written))}; {_ADVICE}")

    def size(key: str) -> float:
        quantity = exact(written[key], unit, gravity=gravity)
        if quantity <= 0.0:
            raise ValueError(f"{key} must be greater than zero")
        return quantity

    value = exact(written["value"], unit, gravity=gravity)
    if "half_width" in written:
        named = written["distribution"]
        shape = next((name for name in _LIMITED if name == named), None)
        if shape is None:
            raise ValueError(f"{named!r} is none of {', '.join(_LIMITED)}")
        return Quantity(value, size("half_width") / _LIMITED[shape], unit), InputDistribution(shape)
    if "U" in written:
        u = size("U") / _positive_number(written, "k")
        return Quantity(value, u, unit), InputDistribution()
    if "dof" in written:
        dof = _positive_number(written, "dof")
        if not _MIN_DOF <= dof < math.inf:
            raise ValueError(f"dof is {dof:g}; give a number from {_MIN_DOF:g}, or leave it out")
        return Quantity(value, size("u"), unit), InputDistribution("t", dof)
    return Quantity(value, size("u"), unit), InputDistribution()


def _positive_number(written: Mapping[str, Any], key: str) -> float:
    number = written[key]
    if isinstance(number, bool) or not isinstance(number, int | float) or not number > 0.0:
        raise ValueError(f"{key} must be a number greater than zero")
    return float(number)
