"""Cells of tables of readings: empty cells, numbers, dates, senses of rotation, and rates."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Mapping
from functools import cached_property
from typing import Any, Final, Protocol

from counterspin.campaign.columns import Sense
from counterspin.campaign.field_types import parse_exact
from counterspin.campaign.quantity import parse_quantity
from counterspin.errors import OutOfRangeError
from counterspin.frozen import frozen
from counterspin.records.unit_notation import bracketed_unit, unit_in_name
from counterspin.units import is_convertible, unit_factor

#: Placeholder of a reading that has not been taken or simulated yet.
BLANK: Final = "?"

#: Pattern of a number with a decimal comma.
DECIMAL_COMMA_PATTERN: Final = r"^\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*$"

#: Date with points, which begins with the day: 01.03.2026.
_DAY_FIRST_DATE: Final = r"^(\d\d)\.(\d\d)\.(\d{4})"

_UTC: Final = datetime.UTC


def replace_decimal_commas(frame: Any) -> Any:
    """Return a table with decimal points in place of decimal commas; other text is unchanged."""
    import polars as pl

    text = pl.col(pl.String())
    return frame.with_columns(
        pl.when(text.str.contains(DECIMAL_COMMA_PATTERN))
        .then(text.str.replace(",", "."))
        .otherwise(text)
    )


def is_empty(value: Any) -> bool:
    """Return whether a cell is empty, or contains a placeholder for a later value."""
    if isinstance(value, str):
        return value.strip().lower() in ("", "nan", BLANK)
    return value is None or (isinstance(value, float) and math.isnan(value))


def parse_number(value: Any) -> float | None:
    """Return a cell as a number; None if it is not a number."""
    if isinstance(value, bool):
        return None
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def cell_text(value: Any) -> str:
    """Return a cell as text; whole numbers have no decimal point."""
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    return "" if value is None else str(value).strip()


def mounting_name(value: Any) -> str:
    """Return a cell as the name of a mounting, without dots, which separate parts of symbols."""
    return re.sub(r"\.(?=\s|$)", "", cell_text(value)).replace(".", ",")


#: Text of a sense of rotation in a table, in lower case -> sense.
SENSE_WORDS: Final[Mapping[str, Sense]] = {
    "counterclockwise": "counterclockwise",
    "counter-clockwise": "counterclockwise",
    "anticlockwise": "counterclockwise",
    "anti-clockwise": "counterclockwise",
    "ccw": "counterclockwise",
    "clockwise": "clockwise",
    "cw": "clockwise",
}


def to_seconds(value: Any) -> Any:
    """Return a date and time in seconds from an arbitrary origin; other values are unchanged."""
    if isinstance(value, str):
        text = re.sub(_DAY_FIRST_DATE, r"\3-\2-\1", value.strip())
        try:
            value = datetime.datetime.fromisoformat(text)
        except ValueError:
            return value
    if isinstance(value, datetime.datetime):
        return value.replace(tzinfo=value.tzinfo or _UTC).timestamp()
    return value


#: Unit of a rate in revolutions -> unit with explicit revolutions.
_REVOLUTION_UNITS: Final = {"1/min": "rpm", "min^-1": "rpm", "Hz": "rev/s"}


class RateSettings(Protocol):
    """Settings of the column of rates."""

    rate_unit: str  #: Unit of the column and of its uncertainties.
    u_rate: str | None  #: Uncertainty of rates without an uncertainty in the table.


@frozen
class RateColumn:
    """Conversion of a column of numbers to rates."""

    settings: RateSettings  #: Section of the table.
    document: Mapping[str, Any]  #: Document with this section.

    def read(self, value: float, u: float | None) -> tuple[float, float, str]:
        """Return a rate, its standard uncertainty and their unit; ValueError if it is not a rate.

        u: Standard uncertainty of the number, in its unit; None: that of the section, if any.
        """
        if u is not None and u < 0.0:
            raise OutOfRangeError("a standard uncertainty cannot be negative")
        rate, unit, power = self._exact(value)
        stated_u = self.settings.u_rate
        if u is None and stated_u is not None:
            return rate, parse_exact(stated_u, "rad/s") / unit_factor(unit, "rad/s"), unit
        return rate, abs(power * rate * (u or 0.0) / value), unit

    def _exact(self, value: float) -> tuple[float, str, float]:
        """Return a rate, its unit, and the exponent of the number in the rate."""
        unit = with_revolutions(self.settings.rate_unit)
        if is_convertible(unit, "s"):
            return 1.0 / (value * unit_factor(unit, "s")), "rev/s", -1.0
        if not is_convertible(unit, "m/s^2"):
            unit_factor(unit, "rad/s")
            return value, unit, 1.0
        if value < 0.0:
            raise OutOfRangeError(
                "a centripetal acceleration must be positive; the mounting determines the sign"
            )
        acceleration = value * unit_factor(unit, "m/s^2", gravity=self._gravity)
        radius = self._stated("centrifuge", "radius", "m")
        return math.sqrt(acceleration / radius), "rad/s", 0.5

    @cached_property
    def _gravity(self) -> float:
        return self._stated("site", "gravity", "m/s^2")

    def _stated(self, section: str, key: str, unit: str) -> float:
        """Return a quantity of another section; its errors are reported there."""
        try:
            return abs(parse_quantity(self.document[section][key], unit).value) or 1.0
        except (KeyError, TypeError, ValueError):
            return 1.0


def unit_of_name(column: str, unit: str) -> str:
    """Return the unit in the name of a column whose unit is stated; empty without one.

    Without brackets, the end of a name is a unit only if it measures the same quantity.
    """
    if unit_in_brackets := bracketed_unit(column):
        return unit_in_brackets
    name_unit = unit_in_name(column)
    return name_unit if is_convertible(with_revolutions(name_unit), with_revolutions(unit)) else ""


def with_revolutions(unit: str) -> str:
    """Return a unit with explicit revolutions: rpm for 1/min; other units are unchanged."""
    return _REVOLUTION_UNITS.get(unit, unit)
