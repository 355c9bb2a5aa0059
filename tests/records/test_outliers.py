"""Outliers of a signal."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from record_files import (
    ANGLE,
    RADIUS,
    SIGNAL,
    TIME,
    make_dense_columns,
    read_written_record,
    simulate_columns,
    write_record,
)

from counterspin.arrays import median
from counterspin.records.record import ColumnSpec
from counterspin.records.signals import FirstHarmonic


@pytest.mark.parametrize("block", [None, "auto"])
def test_gaussian_noise_has_almost_no_outliers(tmp_path, block):
    columns = simulate_columns(n=100_000, step=0.005)
    record = read_written_record(write_record(tmp_path / "run.parquet", columns), block=block)
    assert record.report.outliers[SIGNAL] <= 1  # 2e-4 are expected beyond six deviations
    assert record.report.used == 100_000


@pytest.mark.parametrize("step", [0.02, 0.2, 0.005])
def test_gross_outliers_are_rejected(tmp_path, step):
    columns = simulate_columns(n=20_000, step=step)
    rng = np.random.default_rng(3)
    places = np.sort(rng.choice(20_000, 100, replace=False))
    columns[SIGNAL][places] += rng.choice([-1, 1], 100) * rng.uniform(0.15, 5, 100)
    record = read_written_record(write_record(tmp_path / "run.parquet", columns), block=None)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(record.signals["Qx"])), places)
    assert record.report.outliers[SIGNAL] == 100
    assert [found.row for found in record.report.listed] == (places + 1).tolist()


@pytest.mark.parametrize("filler", [-9.99e33, 9.969209968386869e36, 1e300])
def test_sentinels_for_empty_cells_are_rejected(tmp_path, filler):
    columns = simulate_columns()
    columns[SIGNAL][[5, 400, 401, 999]] = filler
    record = read_written_record(write_record(tmp_path / "run.csv", columns))
    assert record.report.outliers[SIGNAL] == 4
    assert np.flatnonzero(np.isnan(record.signals["Qx"])).tolist() == [5, 400, 401, 999]


@pytest.mark.parametrize("bias", [0.0, 1.0])
def test_outliers_in_one_fifth_of_rows_are_rejected(tmp_path, bias):
    columns = simulate_columns(n=10_000)
    rng = np.random.default_rng(4)
    places = rng.random(10_000) < 0.2
    columns[SIGNAL][places] += bias + 3 * rng.standard_normal(places.sum())
    record = read_written_record(write_record(tmp_path / "run.parquet", columns), block=None)
    lost = np.isnan(record.signals["Qx"])
    gross = np.abs(columns[SIGNAL] - simulate_columns(n=10_000)[SIGNAL]) > 0.15
    assert lost[gross].mean() > 0.99
    assert lost[~places].mean() < 1e-3


def test_harmonics_of_low_noise_record_are_not_outliers(tmp_path):
    # Specific force at 16 ppm of noise: a drifting rate and a K_II stand out of it.
    columns = simulate_columns(n=20_000)
    phase = np.pi / 2 * columns[TIME] * (1 + 5e-7 * columns[TIME])
    columns[ANGLE] = phase
    columns[SIGNAL] = -6.17 * np.cos(phase) + 5e-5 * np.cos(2 * phase)
    columns[SIGNAL] += 1e-4 * np.random.default_rng(6).standard_normal(phase.size)
    path = write_record(tmp_path / "run.parquet", columns)
    record = read_written_record(path, rate=np.pi / 2, swings={})
    assert record.report.outliers[SIGNAL] == 0


@pytest.mark.parametrize("noise", [0.0, 1e-5, 1e-3])
def test_quantised_signals_have_no_outliers(tmp_path, noise):
    columns = simulate_columns(n=20_000, noise=noise)
    columns[SIGNAL] = np.round(columns[SIGNAL], 3)
    record = read_written_record(write_record(tmp_path / "run.parquet", columns))
    assert record.report.outliers[SIGNAL] == 0


def test_noise_free_and_constant_signals_have_no_outliers(tmp_path):
    columns = {**simulate_columns(n=20_000, noise=0.0), "up_m": np.zeros(20_000)}
    record = read_written_record(
        write_record(tmp_path / "run.parquet", columns),
        signals={"Qx": ColumnSpec(SIGNAL), "Qz": ColumnSpec("up_m")},
        swings={"Qx": FirstHarmonic(RADIUS, "m")},
    )
    assert record.report.outliers == {ANGLE: 0, SIGNAL: 0, "up_m": 0}


def test_increased_noise_is_not_outlying(tmp_path):
    columns = simulate_columns(n=20_000)
    columns[SIGNAL][8000:9000] += 0.02 * np.random.default_rng(1).standard_normal(1000)
    record = read_written_record(write_record(tmp_path / "run.parquet", columns))
    assert record.report.outliers[SIGNAL] <= 2


@pytest.mark.parametrize("size", [0.2, 3.0, 1e300])
@pytest.mark.parametrize("row", [3, 127, 128, 20_000, 20_010])
def test_outlier_is_found_at_any_row(tmp_path, row, size):
    # The last window overlaps the one before; all others are clean.
    columns = make_dense_columns(20_011)
    columns[SIGNAL][row] += size
    record = read_written_record(write_record(tmp_path / "run.parquet", columns), block=None)
    assert [outlier.row for outlier in record.report.listed] == [row + 1]


def test_last_window_uses_remaining_noise(tmp_path):
    # Many outliers in all windows but the last, which has small ones: these stand out only once
    # those are no longer counted as noise.
    columns = simulate_columns(n=1000)
    columns[SIGNAL][np.arange(5, 880, 12)] += 3.0
    columns[SIGNAL][[930, 980]] += 0.12
    record = read_written_record(write_record(tmp_path / "run.parquet", columns), block=None)
    rows = [outlier.row - 1 for outlier in record.report.listed]
    assert rows == [*range(5, 880, 12), 930, 980]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-1e6, 1e6) | st.just(math.nan), min_size=1, max_size=40))
def test_median_matches_numpy(values):
    np.testing.assert_equal(median(np.array(values)), np.median(values))
