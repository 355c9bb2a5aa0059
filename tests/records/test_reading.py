"""Reading a record as a whole."""

import math
from dataclasses import replace

import numpy as np
import pytest
from record_files import (
    ANGLE,
    RADIUS,
    RATE,
    SIGNAL,
    TIME,
    format_lines,
    make_dense_columns,
    read_error_message,
    read_written_record,
    simulate_columns,
    write_record,
)

from counterspin.records.record import ColumnSpec


def test_units_are_converted_to_si(tmp_path):
    columns = simulate_columns()
    filed = {
        TIME: columns[TIME] * 1e3 + 5e6,
        ANGLE: np.degrees(columns[ANGLE]),
        SIGNAL: columns[SIGNAL] * 1e3,
    }
    record = read_written_record(
        write_record(tmp_path / "run.csv", filed),
        time=ColumnSpec(TIME, 1e-3),
        angle=ColumnSpec(ANGLE, math.pi / 180),
        signals={"Qx": ColumnSpec(SIGNAL, 1e-3)},
    )
    assert record.start_time == pytest.approx(5000.0)
    np.testing.assert_allclose(record.time, columns[TIME], atol=1e-9)
    np.testing.assert_allclose(record.angle, columns[ANGLE], atol=1e-12)
    np.testing.assert_allclose(record.signals["Qx"], columns[SIGNAL], rtol=1e-14)


def test_record_without_angle_is_read(tmp_path):
    columns = simulate_columns()
    record = read_written_record(write_record(tmp_path / "run.csv", columns), angle=None)
    assert record.angle is None
    assert record.report.rate is None
    np.testing.assert_array_equal(record.signals["Qx"], columns[SIGNAL])


def test_short_record_raises_with_revolutions(tmp_path):
    message = read_error_message(
        write_record(tmp_path / "run.csv", simulate_columns(n=290))
    )  # 5.78 s of 6 s
    assert "2.89 revolutions" in message


def test_infinite_value_raises_with_line(tmp_path):
    for column in (TIME, ANGLE, SIGNAL):
        columns = simulate_columns()
        columns[column][10] = math.inf
        message = read_error_message(write_record(tmp_path / "run.csv", columns))
        assert "line 12" in message
        assert "infinite" in message


def test_infinite_value_raises_at_any_row(tmp_path):
    # In an even stretch, in an uneven one, and in the last window, which overlaps another.
    for row, late in [(500, 0.0), (500, 0.02), (20_010, 0.0)]:
        columns = make_dense_columns(20_011)
        columns[TIME][480:] += late
        columns[ANGLE][480:] += RATE * late
        columns[SIGNAL][row] = -np.inf
        words = read_error_message(write_record(tmp_path / "run.parquet", columns))
        assert f"row {row + 1}: column '{SIGNAL}' contains an infinite value." in words


@pytest.mark.parametrize("word", ["", "nan", "NaN"])
def test_few_empty_cells_are_counted(tmp_path, word):
    text = format_lines(simulate_columns())
    for place, row in ((2, 100), (2, 101), (1, 200), (0, 300)):
        cells = text[row + 1].split(",")
        cells[place] = word
        text[row + 1] = ",".join(cells)
    record = read_written_record(write_record(tmp_path / "run.csv", text))
    assert record.report.empty == {TIME: 1, ANGLE: 1, SIGNAL: 2}
    assert len(record.time) == 998
    assert np.flatnonzero(np.isnan(record.signals["Qx"])).tolist() == [100, 101]


@pytest.mark.parametrize("rows", [2.0, 2.5, 4.0])
@pytest.mark.parametrize("step", [0.02, 0.001])
def test_values_repeated_by_faster_log_are_used_once(tmp_path, rows, step):
    """Amplitude and phase are those of the samples, delayed by less than one row."""
    columns = simulate_columns(int(12.0 / step), step)
    new = (np.arange(len(columns[TIME])) / rows).astype(int)
    first = np.searchsorted(new, new)  # the row in which a value first stands
    columns[SIGNAL] = columns[SIGNAL][first]
    record = read_written_record(write_record(tmp_path / "run.csv", columns))
    part = 1.0 - len(np.unique(first)) / len(first)
    text = (
        f"column '{SIGNAL}' repeats {100.0 * part:.3g} % of the values; the repetitions are "
        "not used"
    )
    assert text in record.report.format_description
    assert record.report.empty[SIGNAL] == 0
    good = np.isfinite(record.signals["Qx"])
    angle = record.angle[good]
    design = np.column_stack([np.cos(angle), np.sin(angle), np.ones_like(angle), angle, angle**2])
    along, across, *_ = np.linalg.lstsq(design, record.signals["Qx"][good], rcond=None)[0]
    assert along == pytest.approx(RADIUS, abs=5e-3)
    assert across == pytest.approx(0.0, abs=5e-3)


@pytest.mark.parametrize("column", [TIME, ANGLE, SIGNAL])
def test_more_than_five_percent_empty_cells_raise(tmp_path, column):
    columns = simulate_columns()
    columns[column][10:61] = np.nan
    path = write_record(tmp_path / "run.csv", columns)
    assert f"'{column}' has 51 empty cells in 1000 rows" in read_error_message(path)
    columns[column][60] = simulate_columns()[column][60]
    read_written_record(write_record(path, columns))


@pytest.mark.parametrize("end", ["first", "last", "both"])
@pytest.mark.parametrize("dense", [False, True])
def test_isolated_rows_are_omitted(tmp_path, end, dense):
    columns = simulate_columns(n=20_000, step=0.0005) if dense else simulate_columns()
    n = len(columns[TIME])
    gap = 6.0  # three revolutions
    lone = {"first": [0, 1], "last": [n - 1], "both": [0, n - 1]}[end]
    if end != "last":
        columns[TIME][[place for place in lone if place < 2]] -= gap
    if end != "first":
        columns[TIME][-1] += gap
    columns[ANGLE] = RATE * columns[TIME]
    columns[SIGNAL][lone] += 0.4
    record = read_written_record(write_record(tmp_path / "run.parquet", columns))
    deletes = {name: np.delete(values, lone) for name, values in columns.items()}
    without = read_written_record(write_record(tmp_path / "rest.parquet", deletes))
    assert record.report.isolated == len(lone)
    assert "from the other rows by a gap" in " ".join(record.report.notes())
    assert record.report.rows == n
    np.testing.assert_array_equal(record.time, without.time)
    np.testing.assert_array_equal(record.signals["Qx"], without.signals["Qx"])
    assert record.start_time == without.start_time


def test_many_rows_beyond_gap_are_preserved(tmp_path):
    columns = simulate_columns()
    columns[TIME][-40:] += 6.0
    columns[ANGLE] = RATE * columns[TIME]
    columns[SIGNAL] = RADIUS * np.cos(columns[ANGLE])
    record = read_written_record(write_record(tmp_path / "run.csv", columns))
    assert record.report.isolated == 0
    assert len(record.time) == 1000


@pytest.mark.parametrize(("revolutions", "refused"), [(4900.0, False), (5100.0, True)])
def test_revolutions_are_limited_by_memory(tmp_path, revolutions, refused):
    columns = simulate_columns(n=1000, step=revolutions * 2.0 * np.pi / RATE / 999.0)
    path = write_record(tmp_path / "run.csv", columns)
    options = {"swings": {}, "angle": None}
    if refused:
        assert (
            "Each revolution after the first 5000 requires at least 16 rows"
            in read_error_message(path, **options)
        )
    else:
        assert len(read_written_record(path, **options).time) == 1000


def test_too_few_rows_per_revolution_raise(tmp_path):
    columns = simulate_columns(n=100, step=2.0 * 30.01)
    options = {"swings": {}, "angle": None}
    assert "too few to track" in read_error_message(
        write_record(tmp_path / "run.csv", columns), **options
    )


def test_outlier_row_counts_omitted_rows(tmp_path):
    columns = simulate_columns()
    columns[TIME][0] -= 6.0
    columns[ANGLE] = RATE * columns[TIME]
    columns[SIGNAL][600] += 1.0
    record = read_written_record(write_record(tmp_path / "run.csv", columns))
    assert [outlier.row for outlier in record.report.listed] == [601]


@pytest.mark.parametrize("size", [1e120, 1e305])
def test_implausible_values_raise(tmp_path, size):
    columns = simulate_columns()
    columns[ANGLE][1::2] *= size
    read_error_message(write_record(tmp_path / "run.csv", columns))
    columns = simulate_columns()
    columns[SIGNAL] *= size
    message = read_error_message(write_record(tmp_path / "run.csv", columns), swings={})
    assert f"column '{SIGNAL}' contains implausible values of up to" in message


def test_repeated_values_leave_the_amplitude(tmp_path):
    """Block means over interpolated values would reduce it by 2e-4."""
    columns = simulate_columns(n=6_000, step=0.01)
    newest_row = np.arange(6_000) // 2 * 2
    columns[SIGNAL] = RADIUS * np.cos(columns[ANGLE][newest_row])
    record = read_written_record(write_record(tmp_path / "run.csv", columns))
    signal = record.signals["Qx"]
    is_new = np.isfinite(signal)
    assert is_new.sum() == 3_000
    np.testing.assert_allclose(signal[is_new], RADIUS * np.cos(record.angle[is_new]), atol=1e-9)


@pytest.mark.parametrize(("start", "factor"), [(1764459000.0, 1.0), (1764459000.0, 1e3)])
def test_times_since_1970_have_no_rounding_error(tmp_path, start, factor):
    """Seconds since 1970 have a resolution of 0.24 us in floating point."""
    columns = simulate_columns()
    columns[TIME] = (start + 0.02 * np.arange(columns[TIME].size)) * factor
    path = write_record(tmp_path / "run.csv", columns)
    record = read_written_record(path, time=ColumnSpec(TIME, 1.0 / factor), block=1)
    np.testing.assert_allclose(np.diff(record.time), 0.02, rtol=1e-9)


@pytest.mark.parametrize(("count", "plural", "verb"), [(1, "", "was"), (2, "s", "were")])
def test_notes_agree_with_their_counts(tmp_path, count, plural, verb):
    report = read_written_record(write_record(tmp_path / "run.csv", simulate_columns())).report
    counts = {"outside": count, "repeated": count, "isolated": count}
    counted = replace(report, **counts, empty={"x": count}, outliers={"x": count})
    assert counted.notes() == [
        f"{count} row{plural} outside the selected part {verb} omitted.",
        f"{count} repeated row{plural} {verb} dropped.",
        f"{count} empty cell{plural} in column 'x' {verb} omitted.",
        f"{count} outlier{plural} in column 'x' {verb} rejected.",
        f"{count} row{plural} separated from the other rows by a gap {verb} omitted.",
    ]
