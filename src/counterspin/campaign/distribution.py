"""Quantities with a distribution (GUM 4.3, JCGM 101, 6.4), as tables; draws from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.quantity import HALF_WIDTHS, InputDistribution, Quantity, parse
from counterspin.errors import InputError, OutOfRangeError

#: The keys with which a value is given, and what they mean.
_FORMS: Final = (
    {"value", "u"},
    {"value", "u", "dof"},
    {"value", "U", "k"},
    {"value", "half_width", "distribution"},
)

_KEYS: Final = set[object]().union(*_FORMS)

#: The tables in JSON Schema.
TABLE_SCHEMA: Final = {
    "type": "object",
    "properties": {
        **{key: {"type": "string"} for key in ("value", "u", "U", "half_width")},
        **{key: {"type": "number"} for key in ("dof", "k")},
        "distribution": {"enum": list(HALF_WIDTHS)},
    },
    "required": ["value"],
    "additionalProperties": False,
}

#: Fewest degrees of freedom of a stated uncertainty.
_MIN_DOF: Final = 1.0

_ADVICE: Final = (
    "give value with u, with u and dof, with U and k, or with half_width and distribution "
    "(rectangular, triangular or arcsine)"
)


def is_prior_table(value: object) -> bool:
    """Return whether a value is a quantity as a table; no term has a name of its keys."""
    return isinstance(value, Mapping) and not _KEYS.isdisjoint(value)


def parse_prior(written: object, unit: str, *, gravity: float | None) -> Quantity:
    """Return a quantity with its standard uncertainty and distribution.

    written: A quantity with ±, which is normal, or a table.
    unit: Of the quantity.

    Raises ValueError if it is neither.
    """
    if not isinstance(written, Mapping):
        return parse(written, unit, gravity=gravity)
    if set(written) not in _FORMS:
        raise InputError(f"has {', '.join(map(str, written))}; {_ADVICE}", "conflicting-keys")

    def exact(key: str) -> float:
        quantity = parse(written[key], unit, gravity=gravity)
        if quantity.u != 0.0:
            raise InputError(f"{key} must not have an uncertainty (±)", "wrong-uncertainty")
        return quantity.value

    def size(key: str) -> float:
        if (quantity := exact(key)) <= 0.0:
            raise OutOfRangeError(f"{key} must be greater than zero")
        return quantity

    value = exact("value")
    if "half_width" in written:
        named = written["distribution"]
        shape = next((name for name in HALF_WIDTHS if name == named), None)
        if shape is None:
            raise InputError(f"{named!r} is not one of {', '.join(HALF_WIDTHS)}", "unknown-choice")
        u = size("half_width") / HALF_WIDTHS[shape]
        return Quantity(value, u, unit, InputDistribution(shape))
    if "U" in written:
        return Quantity(value, size("U") / _positive_number(written, "k"), unit)
    if "dof" in written:
        dof = _positive_number(written, "dof")
        if not _MIN_DOF <= dof < math.inf:
            raise OutOfRangeError(f"dof is {dof:g}; give a number from {_MIN_DOF:g}, or omit it")
        return Quantity(value, size("u"), unit, InputDistribution("t", dof))
    return Quantity(value, size("u"), unit)


def standard_draws(
    distribution: InputDistribution, trials: int, generator: np.random.Generator
) -> Array:
    """Return draws about zero whose standard uncertainty is one (t: whose scale is one)."""
    if distribution.shape == "t":
        return np.asarray(generator.standard_t(distribution.dof, trials))
    if distribution.shape == "rectangular":
        return generator.uniform(-math.sqrt(3.0), math.sqrt(3.0), trials)
    if distribution.shape == "triangular":
        half_width = math.sqrt(6.0)
        return generator.triangular(-half_width, 0.0, half_width, trials)
    if distribution.shape == "arcsine":
        return math.sqrt(2.0) * np.sin(generator.uniform(-0.5 * math.pi, 0.5 * math.pi, trials))
    return generator.standard_normal(trials)


def _positive_number(written: Mapping[str, Any], key: str) -> float:
    number = written[key]
    if isinstance(number, bool) or not isinstance(number, int | float) or not number > 0.0:
        raise OutOfRangeError(f"{key} must be a number greater than zero")
    return float(number)
