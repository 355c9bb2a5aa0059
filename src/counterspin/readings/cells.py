"""Cells of tables of readings: empty cells, numbers, dates, senses of rotation, and rates."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Mapping
from functools import cached_property, lru_cache
from typing import Any, Final, Protocol

from counterspin.campaign.columns import Sense
from counterspin.campaign.field_types import parse_exact
from counterspin.campaign.quantity import parse_quantity
from counterspin.errors import OutOfRangeError
from counterspin.frozen import frozen
from counterspin.units import unit_factor

#: Stands where a reading has no value yet: before it is taken, or simulated.
BLANK: Final = "?"

#: A number whose decimals are parted by a comma.
WITH_COMMA: Final = r"^\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*$"

_UTC: Final = datetime.UTC


def with_points(frame: Any) -> Any:
    """Return a table whose numbers with a comma have a point; other text stays."""
    import polars as pl

    text = pl.col(pl.String())
    return frame.with_columns(
        pl.when(text.str.contains(WITH_COMMA)).then(text.str.replace(",", ".")).otherwise(text)
    )


def is_empty(value: Any) -> bool:
    """Return whether a cell is empty, or has a placeholder for a later value."""
    if isinstance(value, str):
        return value.strip().lower() in ("", "nan", BLANK)
    return value is None or (isinstance(value, float) and math.isnan(value))


def as_number(value: Any) -> float | None:
    """Return a cell as a number, None if it is not a number."""
    if isinstance(value, bool):
        return None
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def words_of(value: Any) -> str:
    """Return a cell as text; a whole number without its point."""
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    return "" if value is None else str(value).strip()


def mounting_of(value: Any) -> str:
    """Return a cell as the name of a mounting; a dot in it would split the name of a term."""
    return re.sub(r"\.(?=\s|$)", "", words_of(value)).replace(".", ",")


#: How tables write in which sense a machine turns, in lower case.
SENSE_WORDS: Final[Mapping[str, Sense]] = {
    "counterclockwise": "counterclockwise",
    "counter-clockwise": "counterclockwise",
    "anticlockwise": "counterclockwise",
    "anti-clockwise": "counterclockwise",
    "ccw": "counterclockwise",
    "clockwise": "clockwise",
    "cw": "clockwise",
}


def seconds_of(value: Any) -> Any:
    """Return a date and time in seconds, of which only differences matter; else the value."""
    if isinstance(value, str):
        try:
            value = datetime.datetime.fromisoformat(value.strip())
        except ValueError:
            return value
    if isinstance(value, datetime.datetime):
        return value.replace(tzinfo=value.tzinfo or _UTC).timestamp()
    return value


#: Unit of a rate that counts revolutions -> how it is written where angles are a unit.
_REVOLUTIONS: Final = {"1/min": "rpm", "min^-1": "rpm", "Hz": "rev/s"}


class RateSettings(Protocol):
    """The statements of a table's section about its column of rates."""

    rate_unit: str  #: Of the column and of its uncertainties.
    u_rate: str | None  #: Of rates without an uncertainty in the table.


@frozen
class RateColumn:
    """The conversion of the column's numbers to rates."""

    settings: RateSettings  #: The section.
    document: Mapping[str, Any]  #: In which it stands.

    def read(self, value: float, u: float | None) -> tuple[float, float, str]:
        """Return a rate, its standard uncertainty and their unit; ValueError if it is not a rate.

        u: Standard uncertainty of the number, in its unit; None: that of the section, if any.
        """
        if u is not None and u < 0.0:
            raise OutOfRangeError("a standard uncertainty cannot be negative")
        rate, unit, power = self._exact(value)
        stated = self.settings.u_rate
        if u is None and stated is not None:
            return rate, parse_exact(stated, "rad/s") / unit_factor(unit, "rad/s"), unit
        return rate, abs(power * rate * (u or 0.0) / value), unit

    def _exact(self, value: float) -> tuple[float, str, float]:
        """Return a rate, its unit, and the exponent of the number in the rate."""
        unit = _REVOLUTIONS.get(self.settings.rate_unit, self.settings.rate_unit)
        if _converts(unit, "s"):
            return 1.0 / (value * unit_factor(unit, "s")), "rev/s", -1.0
        gravity = self._gravity
        if not _converts(unit, "m/s^2", gravity=gravity):
            unit_factor(unit, "rad/s")
            return value, unit, 1.0
        if value < 0.0:
            raise OutOfRangeError(
                "a centripetal acceleration must be positive; the mounting determines the sign"
            )
        acceleration = value * unit_factor(unit, "m/s^2", gravity=gravity)
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


@lru_cache(maxsize=64)
def _converts(unit: str, wanted: str, *, gravity: float | None = None) -> bool:
    try:
        return unit_factor(unit, wanted, gravity=gravity) > 0.0
    except ValueError:
        return False
