"""Time stamps as numbers."""

import polars as pl

from counterspin.records.column_file import nanoseconds


def test_stamps_in_every_form_of_the_standard():
    day = 86_400_000_000_000
    written = {
        "1970-01-02T00:00:00": day,
        "1970-01-02 00:00:00,000000001": day + 1,
        " 1970-01-02T00:00:00.25Z ": day + 250_000_000,
        "1970-01-02T01:30:00+01:30": day,
        "00:00:01.5": 1_500_000_000,
        "12 o'clock": None,
        "": None,
        "1970-13-01T00:00:00": None,
    }
    frame = pl.DataFrame({"t": list(written)})
    assert frame.select(nanoseconds("t"))["t"].to_list() == list(written.values())
