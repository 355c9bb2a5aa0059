"""Record files of Parquet."""

import re
from datetime import datetime, time, timedelta

import numpy as np
import polars as pl
import pytest
from record_files import (
    ANGLE,
    SIGNAL,
    TIME,
    read_error_message,
    read_written_record,
    simulate_columns,
    write_record,
)

from counterspin.ingest.contents import read_contents


def test_text_column_of_parquet_raises(tmp_path):
    columns = {**simulate_columns(), SIGNAL: ["x"] * 1000}
    assert "String" in read_error_message(write_record(tmp_path / "run.parquet", columns))


def test_columns_too_large_for_file_size_raise(tmp_path):
    pl.DataFrame(dict.fromkeys((TIME, ANGLE, SIGNAL), np.zeros(5_000_000))).write_parquet(
        tmp_path / "run.parquet"
    )
    message = read_error_message(tmp_path / "run.parquet")
    assert re.search(r"\d+ bytes, .* 120000000 bytes", message)


def test_columns_of_other_types_are_ignored(tmp_path):
    columns = simulate_columns()
    beside = {"when": [datetime(2026, 1, 1)] * 1000, "note": ["x"] * 1000}
    record = read_written_record(write_record(tmp_path / "run.parquet", {**columns, **beside}))
    np.testing.assert_array_equal(record.signals["Qx"], columns[SIGNAL])


@pytest.mark.parametrize("is_duration", [True, False])
def test_durations_and_times_of_day_are_times(tmp_path, is_duration):
    steps = [timedelta(milliseconds=20 * row) for row in range(50)]
    times = (
        steps if is_duration else [time(12, 0, step.seconds, step.microseconds) for step in steps]
    )
    pl.DataFrame({"time": times, "x": np.arange(50.0)}).write_parquet(tmp_path / "a.parquet")
    column = read_contents(tmp_path / "a.parquet").columns[0]
    assert (column.name, column.is_timestamp) == ("time", True)
    np.testing.assert_allclose(column.values, 0.02 * np.arange(50), atol=1e-12)
