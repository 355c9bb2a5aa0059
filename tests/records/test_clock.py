"""The clock of a record, and the angle that witnesses it."""

import math

import numpy as np
import pytest
from record_files import (
    ANGLE,
    RATE,
    SIGNAL,
    TIME,
    format_lines,
    read_error_message,
    read_written_record,
    simulate_columns,
    write_record,
)

from counterspin.records.record import ColumnSpec


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_decreasing_time_raises_with_line(tmp_path, suffix):
    columns = simulate_columns()
    columns[TIME][500] -= 1.0
    message = read_error_message(write_record(tmp_path / f"run{suffix}", columns))
    assert ("line 502:" if suffix == ".csv" else "row 501:") in message
    assert "the time decreases" in message


def test_decreasing_time_in_long_record_raises_with_row(tmp_path):
    columns = simulate_columns(n=200_000, step=0.005)
    columns[TIME][131_072] = columns[TIME][131_070]
    assert "row 131073:" in read_error_message(write_record(tmp_path / "run.parquet", columns))


def test_repeated_rows_are_dropped_and_counted(tmp_path):
    text = format_lines(simulate_columns())
    other = text[20].split(",")
    other[2] = "2.0"
    text[300:300] = [text[299]] * 3
    text.insert(21, ",".join(other))
    record = read_written_record(write_record(tmp_path / "run.csv", text))
    assert (record.report.repeated, record.report.differing) == (4, 1)
    np.testing.assert_array_equal(record.time, simulate_columns()[TIME])
    np.testing.assert_array_equal(record.signals["Qx"], simulate_columns()[SIGNAL])


def test_clock_jump_raises_with_line(tmp_path):
    columns = simulate_columns()
    columns[TIME][400:] += 0.5
    message = read_error_message(write_record(tmp_path / "run.csv", columns))
    assert "line 402:" in message
    assert "clock jumps" in message
    assert "0.52 s" in message


def test_gaps_are_accepted_and_listed(tmp_path):
    columns = {
        name: np.delete(values, slice(300, 450)) for name, values in simulate_columns().items()
    }
    record = read_written_record(write_record(tmp_path / "run.csv", columns))
    assert record.report.n_gaps == 1
    assert record.report.gaps[0].time == pytest.approx(299 * 0.02)
    assert record.report.gaps[0].length == pytest.approx(151 * 0.02)
    np.testing.assert_array_equal(record.angle, columns[ANGLE])


WRAPS = {
    "0 to 2 pi": lambda a: np.mod(a, 2 * math.pi),
    "-pi to pi": lambda a: math.pi - np.mod(math.pi - a, 2 * math.pi),
}


@pytest.mark.parametrize("wrap", WRAPS.values(), ids=WRAPS)
@pytest.mark.parametrize("rate", [RATE, -RATE])
@pytest.mark.parametrize("hole", [None, slice(300, 301), slice(300, 580)])
def test_wrapped_angles_are_unwrapped(tmp_path, wrap, rate, hole):
    columns = simulate_columns(n=3000, rate=rate)
    expected = columns[ANGLE].copy()
    columns[ANGLE] = wrap(columns[ANGLE])
    if hole is not None:  # the second hole takes 2.8 revolutions
        columns = {name: np.delete(values, hole) for name, values in columns.items()}
        expected = np.delete(expected, hole)
    record = read_written_record(write_record(tmp_path / "run.csv", columns), rate=rate)
    assert record.report.wrapped
    turns = (record.angle - expected) / (2 * math.pi)
    np.testing.assert_allclose(turns, round(turns[0]), atol=1e-12)
    assert record.report.rate == pytest.approx(rate, rel=1e-6)


def test_exact_angle_has_no_encoder_step(tmp_path):
    """Every sixth step of a long record is inspected, which includes every revolution."""
    columns = simulate_columns(n=3432, step=2.0 * math.pi / RATE / 132.0)
    exact = (np.arange(3432) + 5.2) * 2.0 * math.pi / 132.0
    columns[ANGLE] = np.mod(exact, 2 * math.pi)
    record = read_written_record(write_record(tmp_path / "run.parquet", columns))
    assert record.report.block == 2
    np.testing.assert_allclose(record.angle, 0.5 * (exact[:-1:2] + exact[1::2]), rtol=1e-9)


def test_encoder_counts_near_gap_are_not_outliers(tmp_path):
    """At 210.1 counts per row, every tenth row and each gap have an additional count."""
    count = 2.0 * math.pi / 2**14
    columns = simulate_columns(step=210.1 * count / RATE)
    columns[TIME] = np.arange(1000) * 210.1 * count / RATE
    columns[ANGLE] = np.round(np.arange(1000) * 210.1) * count
    holed = {name: np.delete(values, [300, 700]) for name, values in columns.items()}
    record = read_written_record(write_record(tmp_path / "run.csv", holed), swings={})
    assert record.report.n_gaps == 2
    assert record.report.outliers[ANGLE] == 0


def test_wrapped_degrees_with_deviating_rate_are_unwrapped(tmp_path):
    columns = simulate_columns(n=200_000, step=0.03, rate=1.03 * RATE)
    columns[ANGLE] = np.mod(np.degrees(columns[ANGLE]), 360.0)
    record = read_written_record(
        write_record(tmp_path / "run.parquet", columns), angle=ColumnSpec(ANGLE, math.pi / 180)
    )
    np.testing.assert_allclose(record.angle, 1.03 * RATE * record.time, atol=1e-5)


@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("size", [1e-3, 1.0, math.pi, 5.0])
def test_outlying_angle_is_dropped(tmp_path, wrapped, size):
    columns = simulate_columns()
    places = [0, 17, 400, 401, 999]
    columns[ANGLE][places] += size
    if wrapped:
        columns[ANGLE] = np.mod(columns[ANGLE], 2 * math.pi)
    record = read_written_record(write_record(tmp_path / "run.csv", columns))
    assert record.report.outliers[ANGLE] == 5
    np.testing.assert_array_equal(record.time, np.delete(columns[TIME], places))
    np.testing.assert_allclose(record.angle, RATE * record.time, atol=1e-5)


@pytest.mark.parametrize(("suffix", "rows"), [(".csv", 1000), (".parquet", 6000)])
@pytest.mark.parametrize("place", [0, 1, -2, -1])
@pytest.mark.parametrize("size", [1e10, -1e18, 1e300])
def test_implausible_angle_is_dropped_at_any_row(tmp_path, suffix, rows, place, size):
    columns = simulate_columns(n=rows, step=20.0 / rows)
    columns[ANGLE][place] = size
    record = read_written_record(write_record(tmp_path / f"run{suffix}", columns))
    assert (record.report.block > 1) == (rows > 1000)  # Block means of the longer record.
    assert record.report.outliers[ANGLE] == 1
    assert record.report.used == rows - 1
    np.testing.assert_allclose(record.angle, RATE * record.time, atol=1e-5)


def test_column_of_implausible_angles_raises(tmp_path):
    columns = simulate_columns()
    columns[ANGLE][900:951] = 1e18
    message = read_error_message(write_record(tmp_path / "run.csv", columns))
    assert f"'{ANGLE}' has 51 angles above 1e+09 rad" in message
    columns[ANGLE] = simulate_columns()[ANGLE] + 2e9
    assert "1000 angles above" in read_error_message(write_record(tmp_path / "run.csv", columns))


@pytest.mark.parametrize("noisy", [True, False])
@pytest.mark.parametrize("size", [0.01, 0.5])
@pytest.mark.parametrize("place", [100, 500, 990])
def test_angle_jump_raises_with_line(tmp_path, place, size, noisy):
    columns = simulate_columns()
    if not noisy:
        # In an angle without noise the jump is the smallest step that there is.
        columns[ANGLE] = RATE * columns[TIME]
    columns[ANGLE][place:] += size
    message = read_error_message(write_record(tmp_path / "run.csv", columns))
    assert f"line {place + 2}:" in message
    assert "angle differs" in message


def test_coarse_encoder_has_no_outliers(tmp_path):
    columns = simulate_columns(n=20_000, step=0.001)
    columns[ANGLE] = np.floor(columns[ANGLE] / 0.01) * 0.01
    record = read_written_record(write_record(tmp_path / "run.csv", columns), block=None)
    assert record.report.outliers[ANGLE] == 0
    np.testing.assert_array_equal(record.angle, columns[ANGLE])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c[ANGLE].__imul__(180 / math.pi), "in degrees?"),
        (lambda c: c[ANGLE].__itruediv__(2 * math.pi), "in revolutions?"),
        (lambda c: c[ANGLE].__imul__(-1), "opposite sense"),
        (lambda c: c[TIME].__imul__(1e3), "in milliseconds?"),
        (lambda c: c[ANGLE].__imul__(1.2), "within 5 %"),
    ],
)
def test_rate_differing_from_run_raises(tmp_path, change, words):
    columns = simulate_columns()
    change(columns)
    assert words in read_error_message(write_record(tmp_path / "run.csv", columns))


@pytest.mark.parametrize("angle", [True, False])
def test_gap_too_long_to_unwrap_raises(tmp_path, angle):
    columns = simulate_columns()
    columns[TIME][-1] = 1e5  # 50 000 revolutions: the whole trajectory would have to be computed
    columns[ANGLE] = RATE * columns[TIME]
    options = {} if angle else {"angle": None}
    message = read_error_message(write_record(tmp_path / "run.csv", columns), **options)
    assert "line 1001: " in message
    assert "99980 s (4.999e+04 revolutions)" in message
