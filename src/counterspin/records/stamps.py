"""Time stamps in ISO 8601 as numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import polars as pl


def nanoseconds(name: str) -> pl.Expr:
    """Return the stamps of a column of text as integers, ns; null where there is none.

    With a date, since 1970 (UTC, or the place's own time where no zone is stated); without one,
    since midnight. Fractions may have a comma; a blank may stand in the place of the T.
    """
    import polars as pl

    text = pl.col(name).str.strip_chars().str.replace(",", ".", literal=True)
    text = text.str.replace(" ", "T", literal=True).str.replace(r"Z$", "+00:00")
    dated = pl.when(text.str.contains("T", literal=True)).then(text)
    text = dated.otherwise(pl.concat_str([pl.lit("1970-01-01T"), text]))
    zoned = text.str.contains(r"[+-]\d\d:?\d\d$")
    form = "%Y-%m-%dT%H:%M:%S%.f"
    unzoned = pl.when(~zoned).then(text)
    plain = unzoned.str.to_datetime(form, time_unit="ns", strict=False)
    with_zone = pl.when(zoned).then(text)
    placed = with_zone.str.to_datetime(f"{form}%z", time_unit="ns", time_zone="UTC", strict=False)
    return pl.coalesce(placed.dt.replace_time_zone(None), plain).cast(pl.Int64()).alias(name)
