"""What stands in the cells of a table of readings."""

from __future__ import annotations

import datetime
import math
from typing import Any, Final

from counterspin.campaign.readings import BLANK

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
    """Return whether a cell holds nothing, or what stands for a value to come."""
    if isinstance(value, str):
        return value.strip().lower() in ("", "nan", BLANK)
    return value is None or (isinstance(value, float) and math.isnan(value))


def as_number(value: Any) -> float | None:
    """Return a cell as a number, None if it holds something else."""
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


def seconds_of(value: Any) -> Any:
    """Return a date and time in seconds, of which only differences count; else the value."""
    if isinstance(value, str):
        try:
            value = datetime.datetime.fromisoformat(value.strip())
        except ValueError:
            return value
    if isinstance(value, datetime.datetime):
        return value.replace(tzinfo=value.tzinfo or _UTC).timestamp()
    return value
