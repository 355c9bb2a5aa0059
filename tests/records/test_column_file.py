"""Time stamps as numbers, and errors of libraries."""

import polars as pl
import pytest

from counterspin.errors import DamagedFileError
from counterspin.records.column_file import parse_nanoseconds, record_errors
from counterspin.records.csv_file import CsvFile
from counterspin.records.layout import TIMESTAMP


def test_time_stamps_of_iso_8601_are_parsed():
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
    assert frame.select(parse_nanoseconds("t"))["t"].to_list() == list(written.values())


@pytest.mark.parametrize(
    "text",
    [
        "05-Mar-2024 10:00:00.02",
        "5 March 2024 10:00:00.02",
        "Mar 05, 2024 10:00:00.02",
        "March 5 2024 10:00:00.02",
        "Tue Mar  5 10:00:00.02 2024",
        "Tue, 05 Mar 2024 10:00:00.02",
        "20240305T100000.02",
        "20240305T100000.020Z",
        "2024-03-05 10:00:00.02 UTC",
        "3/5/2024 10:00:00.02 am",
    ],
)
def test_time_stamps_with_month_names_or_without_separators(text):
    assert TIMESTAMP.fullmatch(text)
    moment = pl.DataFrame({"t": [text]}).select(parse_nanoseconds("t"))["t"].to_list()
    assert moment == [1_709_632_800_020_000_000]


@pytest.mark.parametrize("text", ["0.25 s", "0,25 sec", "250 ms", "2.5e5 us"])
def test_durations_with_unit_are_parsed(text):
    assert TIMESTAMP.fullmatch(text)
    length = pl.DataFrame({"t": [text]}).select(parse_nanoseconds("t"))["t"].to_list()
    assert length == [250_000_000]


def test_times_of_day_continue_after_midnight(tmp_path):
    """Vary the chunks in which the file is read."""
    (tmp_path / "a.csv").write_text(
        "t,u,v\n23:59:59.5,1,2026-01-01T23:59:59\n,2,\n00:00:00.5,3,2026-01-01T00:00:00\n"
        "18:00:00,4,2026-01-01T00:00:01\n00:00:00,5,2026-01-01T00:00:02\n"
    )
    with (
        (tmp_path / "a.csv").open("rb", buffering=0) as stream,
        CsvFile(tmp_path / "a.csv", stream) as file,
    ):
        file.timestamp_columns = frozenset("t")
        file.require(["t"])
        stamps = file.table().select(parse_nanoseconds("t"))["t"]
        for pieces in ([5], [1, 4], [3, 2], [1, 1, 1, 1, 1]):
            file.first_timestamp, place, seconds = None, 0, []
            for size in pieces:
                seconds += file.elapsed_seconds(stamps[place : place + size]).tolist()
                place += size
            assert seconds[0] == 0.0
            assert seconds[1] != seconds[1]
            assert seconds[2:] == pytest.approx([1.0, 64800.5, 86400.5], abs=1e-9)
        # A date that goes back is a clock that runs backwards.
        file.first_timestamp = None
        dated = file.elapsed_seconds(file.table().select(parse_nanoseconds("v"))["v"])
        assert dated[2] == -86399.0


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("do you need to open the file in universal-newline mode?"),
        BaseException("called `Result::unwrap()` on an `Err` value: decimal256"),
        OSError("Unable to synchronously open object (bad symbol table)"),
    ],
)
def test_library_messages_are_replaced(tmp_path, error):
    path = tmp_path / "run.csv"
    with pytest.raises(DamagedFileError) as caught, record_errors(path, lambda: " after row 7"):
        raise error
    assert str(caught.value) == (
        f"{path}: the file is damaged after row 7, or it contains data that counterspin cannot "
        "read. Export the file again, or export it as CSV."
    )
    assert caught.value.__cause__ is error
