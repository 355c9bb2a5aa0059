"""The files of one run as one, and the angle between pulses."""

import math

import numpy as np
import pytest
from raising import raises
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
from counterspin.records.run_file import interpolate_pulses


def write_in_two_files(folder, cut=400):
    text = format_lines(simulate_columns())
    return write_record(folder / "a.csv", text[:cut]), write_record(
        folder / "b.csv", [text[0], *text[cut:]]
    )


def test_record_continues_in_further_files(tmp_path):
    written_record = read_written_record(write_record(tmp_path / "whole.csv", simulate_columns()))
    first, second = write_in_two_files(tmp_path)
    record = read_written_record(first, continuation_files=(second,))
    np.testing.assert_array_equal(record.time, written_record.time)
    np.testing.assert_array_equal(record.signals["Qx"], written_record.signals["Qx"])
    assert record.other_files[second].size == second.stat().st_size
    assert "2 concatenated files" in record.report.notes()[0]


def test_error_in_continuation_file_names_file(tmp_path):
    first, second = write_in_two_files(tmp_path)
    text = second.read_text().splitlines()
    text[3] = text[3].replace(text[3].split(",")[0], "0.5")
    write_record(second, text)
    assert "b.csv, line 4: the time decreases" in read_error_message(
        first, continuation_files=(second,)
    )


def test_row_counter_replaces_missing_time(tmp_path):
    columns = simulate_columns()
    step = columns.pop(TIME)[1]
    time = ColumnSpec("", step, kind="rows")
    record = read_written_record(write_record(tmp_path / "run.csv", columns), time=time)
    np.testing.assert_allclose(record.time, simulate_columns()[TIME], atol=1e-12)
    first, second = write_in_two_files(tmp_path)
    np.testing.assert_array_equal(
        read_written_record(first, continuation_files=(second,), time=time).time, record.time
    )


def test_time_range_selects_part_of_record(tmp_path):
    path = write_record(tmp_path / "run.csv", simulate_columns())
    record = read_written_record(path, time_range=(3.0, 15.0))
    assert record.start_time == 3.0
    assert record.time[-1] == pytest.approx(12.0)
    assert record.report.outside == 1000 - 601
    assert "399 rows outside the selected part were omitted." in record.report.notes()
    assert "in the selected part" in read_error_message(path, time_range=(30.0, 50.0))


def test_units_are_read_from_file_or_compared(tmp_path):
    text = format_lines(simulate_columns())
    text.insert(1, "s,rad,m")
    path = write_record(tmp_path / "run.csv", text)
    taken = {
        "time": ColumnSpec(TIME, target_unit="s"),
        "angle": ColumnSpec(ANGLE, -1.0, target_unit="rad"),
        "signals": {"Qx": ColumnSpec(SIGNAL, target_unit="m")},
    }
    np.testing.assert_array_equal(
        read_written_record(path, -RATE, **taken).angle, -simulate_columns()[ANGLE]
    )
    stated = ColumnSpec(TIME, 1e-3, unit="ms", target_unit="s")
    assert "is in 's' according to the units row of the file, but in 'ms'" in read_error_message(
        path, time=stated
    )
    plain = write_record(tmp_path / "plain.csv", simulate_columns())
    assert f"column '{TIME}' has no unit in the file" in read_error_message(plain, **taken)


# Pulses


def pulse_times(rate=-RATE, per_revolution=2, drift=1e-3, turns=20):
    """Return times at which theta = rate (t + drift t^2 / 2) is a whole number of steps."""
    steps = np.arange(turns * per_revolution) * 2 * math.pi / per_revolution / abs(rate)
    return (np.sqrt(1 + 2 * drift * steps) - 1) / drift


def test_pulse_angle_follows_constant_drift():
    pulses = pulse_times()
    time = np.linspace(pulses[0] - 0.5, pulses[-1] + 0.5, 997)
    expected = -RATE * (time + 0.5e-3 * time**2)
    exact = interpolate_pulses(pulses, time, -RATE, 2)
    np.testing.assert_allclose(exact, expected, atol=1e-5)
    inside = (time > pulses[0]) & (time < pulses[-1])
    np.testing.assert_allclose(exact[inside], expected[inside], atol=2e-7)
    # A pulse that was missed is a double interval; far beyond the pulses there is no angle.
    np.testing.assert_allclose(
        interpolate_pulses(np.delete(pulses, 7), time, -RATE, 2), exact, atol=1e-5
    )
    assert np.isnan(interpolate_pulses(pulses, pulses[-1:] + 2.5, -RATE, 2)).all()


def test_pulse_angle_is_continuous_through_scattered_pulses():
    scatter = 1e-4 * np.random.default_rng(3).standard_normal(40)
    pulses = pulse_times() + scatter
    at = [interpolate_pulses(pulses, pulses + shift, -RATE, 2) for shift in (-1e-9, 0.0, 1e-9)]
    np.testing.assert_allclose(at[1], -math.pi * np.arange(40), atol=1e-12)
    for beside in (at[0], at[2]):
        np.testing.assert_allclose(beside, at[1], atol=1e-8)  # the rate for 1 ns is 3e-9


@pytest.mark.parametrize(
    ("pulses", "rate", "words"),
    [
        (pulse_times()[:2], RATE, "too few"),
        (pulse_times()[::-1], RATE, "not later"),
        (pulse_times(), 2 * RATE, "should be 0.5 s"),
        (np.insert(pulse_times(), 5, pulse_times()[4] + 0.4), RATE, "pulse 6 comes 0.4 s after"),
    ],
)
def test_invalid_pulses_raise(pulses, rate, words):
    with pytest.raises(ValueError, match=words):
        interpolate_pulses(pulses, np.zeros(1), rate, 2)


def test_angle_from_pulses_in_second_file(tmp_path):
    columns = simulate_columns()
    angle = columns.pop(ANGLE)
    turns = np.arange(10) * math.tau
    pulses = write_record(
        tmp_path / "index.csv", {TIME: np.interp(turns, angle, simulate_columns()[TIME])}
    )
    spec = ColumnSpec(TIME, kind="pulses")
    record = read_written_record(
        write_record(tmp_path / "run.csv", columns), angle=spec, pulses=pulses
    )
    np.testing.assert_allclose(record.angle, angle[: len(record.angle)], atol=1e-4)
    assert record.other_files[pulses].size == pulses.stat().st_size
    pulses.write_text("time_s\n1\n2.5\n4\n")
    with raises("rate-mismatch", "index.csv:", "'time_s'", "2 s"):
        read_written_record(tmp_path / "run.csv", angle=spec, pulses=pulses)
