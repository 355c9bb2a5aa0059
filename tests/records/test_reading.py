"""Reading a record as a whole."""

import math

import numpy as np
import pytest
from record_files import ANGLE, RATE, SIGNAL, TIME, dense, lines, read, refusal, table, write

from counterspin.records.record import ColumnSpec


def test_units_become_si(tmp_path):
    columns = table()
    filed = {
        TIME: columns[TIME] * 1e3 + 5e6,
        ANGLE: np.degrees(columns[ANGLE]),
        SIGNAL: columns[SIGNAL] * 1e3,
    }
    record = read(
        write(tmp_path / "run.csv", filed),
        time=ColumnSpec(TIME, 1e-3),
        angle=ColumnSpec(ANGLE, math.pi / 180),
        signals={"Qx": ColumnSpec(SIGNAL, 1e-3)},
    )
    assert record.start_time == pytest.approx(5000.0)
    np.testing.assert_allclose(record.time, columns[TIME], atol=1e-9)
    np.testing.assert_allclose(record.angle, columns[ANGLE], atol=1e-12)
    np.testing.assert_allclose(record.signals["Qx"], columns[SIGNAL], rtol=1e-14)


def test_without_an_angle(tmp_path):
    columns = table()
    record = read(write(tmp_path / "run.csv", columns), angle=None)
    assert record.angle is None
    assert record.report.rate is None
    np.testing.assert_array_equal(record.signals["Qx"], columns[SIGNAL])


def test_short_record(tmp_path):
    message = refusal(write(tmp_path / "run.csv", table(n=290)))  # 5.78 s of 6 s
    assert "2.89 revolutions" in message


def test_infinite_values(tmp_path):
    for column in (TIME, ANGLE, SIGNAL):
        columns = table()
        columns[column][10] = math.inf
        message = refusal(write(tmp_path / "run.csv", columns))
        assert "line 12" in message
        assert "infinite" in message


def test_an_infinite_value_is_refused_wherever_it_stands(tmp_path):
    # In an even stretch, in an uneven one, and in the last window, which overlaps another.
    for row, late in [(500, 0.0), (500, 0.02), (20_010, 0.0)]:
        columns = dense(20_011)
        columns[TIME][480:] += late
        columns[ANGLE][480:] += RATE * late
        columns[SIGNAL][row] = -np.inf
        words = refusal(write(tmp_path / "run.parquet", columns))
        assert f"row {row + 1}: column '{SIGNAL}' holds an infinite value." in words


@pytest.mark.parametrize("word", ["", "nan", "NaN"])
def test_few_empty_cells_are_counted(tmp_path, word):
    text = lines(table())
    for place, row in ((2, 100), (2, 101), (1, 200), (0, 300)):
        cells = text[row + 1].split(",")
        cells[place] = word
        text[row + 1] = ",".join(cells)
    record = read(write(tmp_path / "run.csv", text))
    assert record.report.empty == {TIME: 1, ANGLE: 1, SIGNAL: 2}
    assert len(record.time) == 998
    assert np.flatnonzero(np.isnan(record.signals["Qx"])).tolist() == [100, 101]


@pytest.mark.parametrize("column", [TIME, ANGLE, SIGNAL])
def test_more_than_five_percent_empty(tmp_path, column):
    columns = table()
    columns[column][10:61] = np.nan
    path = write(tmp_path / "run.csv", columns)
    assert f"'{column}' has 51 empty cells in 1000 rows" in refusal(path)
    columns[column][60] = table()[column][60]
    read(write(path, columns))
