"""The unit of a signal, by its wave."""

import numpy as np
import pytest
from record_files import (
    ANGLE,
    RATE,
    SIGNAL,
    TIME,
    read_error_message,
    read_written_record,
    simulate_columns,
    write_record,
)

from counterspin.records.signals import FirstHarmonic


@pytest.mark.parametrize("factor", [1e3, 1e-3, 1e2])
@pytest.mark.parametrize("place", [300, 1500, 2700])
@pytest.mark.parametrize("start", [False, True])
def test_change_of_unit_raises_with_line(tmp_path, factor, place, start):
    columns = simulate_columns(n=3000)
    part = slice(None, place) if start else slice(place, None)
    columns[SIGNAL][part] *= factor
    message = read_error_message(write_record(tmp_path / "run.csv", columns))
    assert "changes its unit or scale" in message
    line_number = int(message.split("line ")[1].split(":")[0])
    # Where the wave crosses zero, one unit is as good as the other.
    assert abs(line_number - 2 - place) <= 2


@pytest.mark.parametrize("length", [80, 100, 170])
@pytest.mark.parametrize("filler", [0.0, -9999.0])
def test_dropout_is_rejected_and_counted(tmp_path, length, filler):
    """The dropout is longer than the outlier window, where it would be the majority."""
    columns = simulate_columns(n=4000)
    columns[SIGNAL] += 0.02 * columns[TIME] ** 2 + 100.0
    dead = slice(1500, 1500 + length)
    columns[SIGNAL][dead] = filler
    record = read_written_record(write_record(tmp_path / "run.csv", columns))
    flatnonzero = np.flatnonzero(np.isnan(record.signals["Qx"]))
    assert set(flatnonzero) >= set(range(1500, 1500 + length))
    assert len(flatnonzero) <= length + 20
    assert record.report.outliers[SIGNAL] == len(flatnonzero)


def test_empty_cell_in_dropout_is_counted_once(tmp_path):
    columns = simulate_columns(n=4000)
    columns[SIGNAL][1500:1620] = -9999.0
    columns[SIGNAL][[1520, 1521]] = np.nan
    report = read_written_record(write_record(tmp_path / "run.csv", columns)).report
    assert report.empty[SIGNAL] == 2
    assert report.outliers[SIGNAL] == 118


def test_long_dropout_raises(tmp_path):
    for dead, words in (
        (slice(1500, 1750), "between 30.24 s and 34.88 s after its start"),
        (slice(2500, None), "the once-per-revolution component stops"),
        (slice(None, 250), "the once-per-revolution component only starts"),
    ):
        columns = simulate_columns(n=4000)
        columns[SIGNAL][dead] = 0.0
        assert words in read_error_message(write_record(tmp_path / "run.csv", columns))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: 1e3 * s, "m and mm"),
        (lambda s: 0.0 * s, "has an amplitude of 0 m"),
        (
            lambda s: 0.2 * s,
            "but 2.5 m is expected",
        ),
        (lambda s: -s, "180 degrees"),
        (lambda s: np.roll(s, 25), "check the input axis"),
    ],
)
def test_displacement_differing_from_motion_raises(tmp_path, change, words):
    columns = simulate_columns(n=3000)
    columns[SIGNAL] = change(columns[SIGNAL])
    assert words in read_error_message(write_record(tmp_path / "run.csv", columns))


def test_signal_without_stated_amplitude_is_accepted(tmp_path):
    columns = simulate_columns(n=3000)
    columns[SIGNAL] *= -RATE * 10
    read_written_record(write_record(tmp_path / "run.csv", columns), swings={})


def test_amplitude_hidden_by_noise_is_accepted(tmp_path):
    """In a slow run the specific force is a tenth of the noise of a sample."""
    columns = simulate_columns(n=1000, noise=0.0)
    rng = np.random.default_rng(5)
    columns[SIGNAL] = 1e-3 * np.cos(columns[ANGLE]) + 1e-2 * rng.standard_normal(1000)
    path = write_record(tmp_path / "run.csv", columns)
    read_written_record(path, swings={"Qx": FirstHarmonic(1e-3, "m/s^2")})
    # What the records do show is told all the same.
    message = read_error_message(path, swings={"Qx": FirstHarmonic(0.1, "m/s^2")})
    assert "but 0.1 m/s^2 is expected" in message


def simulate_growing_wave(n=3000, noise=1e-5):
    """Return the error along the spindle axis: a growing wave and a trend."""
    columns = simulate_columns(n=n, noise=0.0)
    time, rng = columns[TIME], np.random.default_rng(8)
    wave = 1e-4 * time * np.cos(columns[ANGLE]) + 9.8 + 1e-3 * time**2
    columns[SIGNAL] = wave + noise * rng.standard_normal(n)
    return columns


@pytest.mark.parametrize("noise", [1e-6, 1e-5, 1e-4, 1e-3])
def test_growing_wave_along_spindle_axis_is_accepted(tmp_path, noise):
    read_written_record(
        write_record(tmp_path / "run.csv", simulate_growing_wave(noise=noise)), swings={}
    )


@pytest.mark.parametrize("factor", [1e3, 9.80665])
def test_jump_of_wave_along_spindle_axis_raises(tmp_path, factor):
    columns = simulate_growing_wave()
    columns[SIGNAL][1500:] *= factor
    message = read_error_message(write_record(tmp_path / "run.csv", columns), swings={})
    assert "changes its unit or scale" in message
    assert abs(int(message.split("line ")[1].split(":")[0]) - 1502) <= 2


def test_weak_wave_of_few_samples_is_accepted(tmp_path):
    # 13 samples a revolution tell the wave's size to a quarter of itself.
    for seed in range(40):
        columns = simulate_columns(n=400, step=2 / 13, noise=0.0)
        rng = np.random.default_rng(seed)
        columns[SIGNAL] = 0.05 * np.cos(columns[ANGLE]) + 0.009 * rng.standard_normal(400)
        read_written_record(
            write_record(tmp_path / "run.csv", columns), swings={"Qx": FirstHarmonic(0.05, "m")}
        )


@pytest.mark.parametrize("part", [0.72, 0.8, 0.88, 0.95])
def test_incomplete_last_revolution_is_accepted(tmp_path, part):
    # A trend that the fitted parabola does not follow passes for a wave in part of a revolution.
    columns = simulate_columns(n=int(100 * (6 + part)), noise=0.0)
    columns[SIGNAL] = 0.05 * np.cos(columns[ANGLE]) + 0.02 * columns[TIME] ** 3
    read_written_record(
        write_record(tmp_path / "run.csv", columns), swings={"Qx": FirstHarmonic(0.05, "m")}
    )
