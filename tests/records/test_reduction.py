"""Block means."""

import math

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from record_files import (
    ANGLE,
    RADIUS,
    RATE,
    SIGNAL,
    TIME,
    make_dense_columns,
    read_written_record,
    write_record,
)

from counterspin.records.record import ColumnSpec
from counterspin.records.signals import FirstHarmonic


def test_blocks_are_exact_means(tmp_path):
    columns = make_dense_columns()
    record = read_written_record(write_record(tmp_path / "run.parquet", columns))
    assert record.report.block == 50
    means = {name: values.reshape(-1, 50).mean(axis=1) for name, values in columns.items()}
    np.testing.assert_allclose(record.time, means[TIME], rtol=1e-13)
    np.testing.assert_allclose(record.angle, means[ANGLE], rtol=1e-13)
    np.testing.assert_allclose(record.signals["Qx"], means[SIGNAL], atol=1e-13)
    spread = columns[TIME].reshape(-1, 50).std(axis=1)
    np.testing.assert_allclose(record.time_sd, spread, rtol=1e-6)
    assert (record.count == 50).all()


def test_angle_sd_covers_scattering_times(tmp_path):
    """Time stamps with an error of 1/20 step; accurate time stamps need no angle_sd."""
    columns = make_dense_columns(20_000)
    assert np.isnan(
        read_written_record(write_record(tmp_path / "good.parquet", columns)).angle_sd
    ).all()
    step = columns[TIME][1]
    rng = np.random.default_rng(6)
    columns[TIME] = columns[TIME] + 0.05 * step * rng.standard_normal(20_000)
    columns[TIME][0] = 0.0
    record = read_written_record(write_record(tmp_path / "run.parquet", columns))
    spread = columns[ANGLE].reshape(-1, record.report.block).std(axis=1)
    np.testing.assert_allclose(record.angle_sd, spread, rtol=1e-9)


def test_point_samples_are_not_averaged(tmp_path):
    record = read_written_record(
        write_record(tmp_path / "run.parquet", make_dense_columns(20_000)), block=None
    )
    assert len(record.time) == 20_000
    assert (record.count == 1).all()
    assert (record.time_sd == 0).all()


def test_blocks_of_damaged_record_have_normal_residuals(tmp_path):
    columns = make_dense_columns()
    rng = np.random.default_rng(5)
    columns[ANGLE] = np.mod(columns[ANGLE], 2 * math.pi)
    gross = np.zeros(300_000, dtype=bool)
    gross[rng.choice(300_000, 3000, replace=False)] = True
    columns[SIGNAL][gross] += 5.0
    columns[SIGNAL][rng.choice(300_000, 3000, replace=False)] = np.nan
    keep = np.ones(300_000, dtype=bool)
    keep[rng.choice(300_000, 300, replace=False)] = False
    keep[150_000:163_000] = False
    columns = {name: values[keep] for name, values in columns.items()}
    record = read_written_record(write_record(tmp_path / "run.parquet", columns))
    assert record.report.outliers[SIGNAL] == np.sum(gross[keep] & ~np.isnan(columns[SIGNAL]))
    assert record.time_sd.max() < 1.05 * 50 * record.report.step / math.sqrt(12)
    assert (np.diff(record.time) > 0).all()
    # Mean of R cos over a block, to second order in its spread; the parabola likewise.
    middle = RADIUS * np.cos(record.angle) * (1 - (RATE * record.time_sd) ** 2 / 2)
    qx = record.signals["Qx"] - middle - 1e-3 * (record.time**2 + record.time_sd**2)
    normal = qx * np.sqrt(record.count) / 0.01
    assert np.nanmax(np.abs(normal)) < 6
    assert np.nanstd(normal) == pytest.approx(1.0, abs=0.05)


def test_two_accelerometers_share_rows_of_block(tmp_path):
    columns = make_dense_columns()
    columns["north_m"] = RADIUS * np.sin(RATE * columns[TIME])
    columns["north_m"][1000:1200] = np.nan  # four whole blocks
    columns["north_m"][5003] = np.nan
    record = read_written_record(
        write_record(tmp_path / "run.parquet", columns),
        signals={"Qx": ColumnSpec(SIGNAL), "Qy": ColumnSpec("north_m")},
        swings={"Qx": FirstHarmonic(RADIUS, "m"), "Qy": FirstHarmonic(1j * RADIUS, "m")},
    )
    assert np.flatnonzero(np.isnan(record.signals["Qy"])).tolist() == [20, 21, 22, 23]
    assert not np.isnan(record.signals["Qx"]).any()
    assert record.count[20] == 50
    assert record.count[100] == 49
    expected = np.delete(columns[SIGNAL][5000:5050], 3).mean()
    assert record.signals["Qx"][100] == pytest.approx(expected, abs=1e-13)


@settings(max_examples=6, deadline=None)
@given(st.integers(1, 200_000), st.integers(0, 2**32 - 1))
def test_result_does_not_depend_on_batch_size(tmp_path_factory, batch, seed):
    # Row groups of any size hand the rows over in other batches; pieces stay the same.
    columns = make_dense_columns(140_000)
    rng = np.random.default_rng(seed)
    columns[SIGNAL][rng.choice(140_000, 50, replace=False)] += 3.0
    columns[SIGNAL][rng.choice(140_000, 50, replace=False)] = np.nan
    path = tmp_path_factory.mktemp("batches") / "run.parquet"
    frame = pl.DataFrame(columns)
    frame.write_parquet(path, row_group_size=max(batch, 2000))
    written_record = read_written_record(path)
    frame.write_parquet(path)
    other = read_written_record(path)
    np.testing.assert_array_equal(written_record.time, other.time)
    np.testing.assert_array_equal(written_record.signals["Qx"], other.signals["Qx"])
    assert written_record.report == other.report
