"""Quantities with a stated distribution (GUM 4.3; JCGM 101, 6.4), and draws from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.quantity import HALF_WIDTHS, InputDistribution, Quantity, parse_quantity
from counterspin.errors import InputError, OutOfRangeError

#: Allowed sets of keys of a table.
_KEY_SETS: Final = (
    {"value", "u"},
    {"value", "u", "dof"},
    {"value", "U", "k"},
    {"value", "half_width", "distribution"},
)

_KEYS: Final = set[object]().union(*_KEY_SETS)

#: JSON Schema of the tables.
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

#: Smallest degrees of freedom of a stated uncertainty.
_MIN_DOF: Final = 1.0

_ADVICE: Final = (
    "give value with u, with u and dof, with U and k, or with half_width and distribution "
    "(rectangular, triangular or arcsine)"
)


def is_prior_table(value: object) -> bool:
    """Return whether a value is a table with keys of a quantity; no term has such a name."""
    return isinstance(value, Mapping) and not _KEYS.isdisjoint(value)


def parse_prior(raw: object, unit: str, *, gravity: float | None) -> Quantity:
    """Return a quantity with its standard uncertainty and distribution.

    raw: A quantity with ±, which is normal, or a table.
    unit: Unit of the result.

    Raises ValueError for other values.
    """
    if not isinstance(raw, Mapping):
        return parse_quantity(raw, unit, gravity=gravity)
    if set(raw) not in _KEY_SETS:
        keys_text = ", ".join(map(str, raw)) or "no keys"
        raise InputError(f"has {keys_text}; {_ADVICE}", "conflicting-keys")

    def parse_exact_key(key: str) -> float:
        quantity = parse_quantity(raw[key], unit, gravity=gravity)
        if quantity.u != 0.0:
            raise InputError(f"{key} must not have an uncertainty (±)", "wrong-uncertainty")
        return quantity.value

    def parse_positive_key(key: str) -> float:
        if (number := parse_exact_key(key)) <= 0.0:
            raise OutOfRangeError(f"{key} must be greater than zero")
        return number

    value = parse_exact_key("value")
    if "half_width" in raw:
        distribution_name = raw["distribution"]
        shape = next((name for name in HALF_WIDTHS if name == distribution_name), None)
        if shape is None:
            raise InputError(
                f"{distribution_name!r} is not one of {', '.join(HALF_WIDTHS)}", "unknown-choice"
            )
        u = parse_positive_key("half_width") / HALF_WIDTHS[shape]
        return Quantity(value, u, unit, InputDistribution(shape))
    if "U" in raw:
        return Quantity(value, parse_positive_key("U") / _parse_positive_number(raw, "k"), unit)
    if "dof" in raw:
        dof = _parse_positive_number(raw, "dof")
        if not _MIN_DOF <= dof < math.inf:
            raise OutOfRangeError(
                f"dof is {dof:g}; give a number of at least {_MIN_DOF:g}, or omit it"
            )
        return Quantity(value, parse_positive_key("u"), unit, InputDistribution("t", dof))
    return Quantity(value, parse_positive_key("u"), unit)


def draw_standardized(
    distribution: InputDistribution, n_draws: int, generator: np.random.Generator
) -> Array:
    """Draw values with mean zero and unit standard deviation (t: unit scale)."""
    if distribution.shape == "t":
        return np.asarray(generator.standard_t(distribution.dof, n_draws))
    if distribution.shape == "rectangular":
        return generator.uniform(-math.sqrt(3.0), math.sqrt(3.0), n_draws)
    if distribution.shape == "triangular":
        half_width = math.sqrt(6.0)
        return generator.triangular(-half_width, 0.0, half_width, n_draws)
    if distribution.shape == "arcsine":
        return math.sqrt(2.0) * np.sin(generator.uniform(-0.5 * math.pi, 0.5 * math.pi, n_draws))
    return generator.standard_normal(n_draws)


def _parse_positive_number(table: Mapping[str, Any], key: str) -> float:
    number = table[key]
    if isinstance(number, bool) or not isinstance(number, int | float) or not number > 0.0:
        raise OutOfRangeError(f"{key} must be a number greater than zero")
    return float(number)
