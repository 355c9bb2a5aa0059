"""Record files of HDF5 and MATLAB."""

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.sparse
from record_files import (
    ANGLE,
    SIGNAL,
    TIME,
    read_error_message,
    read_written_record,
    simulate_columns,
)
from scipy.io import savemat

from counterspin.records.dialect import Dialect
from counterspin.records.formats import open_columns
from counterspin.records.record import ColumnSpec


def test_dataset_without_dataspace_raises(tmp_path):
    with h5py.File(tmp_path / "run.h5", "w") as file:
        for name in simulate_columns():
            file[name] = h5py.Empty("f8")
    assert f"'{TIME}' has the shape None; a single column is required" in read_error_message(
        tmp_path / "run.h5"
    )


def test_columns_of_different_length_raise(tmp_path):
    with h5py.File(tmp_path / "run.h5", "w") as file:
        for name, values in simulate_columns().items():
            file[name] = values[: 900 if name == TIME else None]
    assert "length" in read_error_message(tmp_path / "run.h5")


def write_compressed_columns(path):
    """Write columns that compress to a thousandth of their size."""
    zeros = np.zeros(5_000_000)
    if path.suffix == ".mat":
        savemat(path, dict.fromkeys((TIME, ANGLE, SIGNAL), zeros), do_compression=True)
    else:
        with h5py.File(path, "w") as file:
            for name in (TIME, ANGLE, SIGNAL):
                file.create_dataset(name, shape=(10**12,), dtype="f8", chunks=(1000,))
    return path


@pytest.mark.parametrize("name", ["run.mat", "run.h5"])
def test_columns_too_large_for_file_size_raise(tmp_path, name):
    message = read_error_message(write_compressed_columns(tmp_path / name))
    assert re.search(r"\d+ bytes, .* \d+ bytes", message)


def write_hdf5(path, signal=None):
    """Write a file whose signal is left to the caller."""
    columns = simulate_columns()
    with h5py.File(path, "w") as file:
        file[TIME], file[ANGLE] = columns[TIME], columns[ANGLE]
        if signal is not None:
            signal(file, columns[SIGNAL])
    return path


def write_external_dataset(file, values):
    raw = Path(file.filename).with_suffix(".raw")
    raw.write_bytes(values.tobytes())
    where = [(str(raw), 0, h5py.h5f.UNLIMITED)]
    file.create_dataset(SIGNAL, shape=values.shape, dtype="f8", external=where)


def write_virtual_dataset(file, values):
    other = Path(file.filename).with_suffix(".other")
    with h5py.File(other, "w") as second:
        second["x"] = values
    layout = h5py.VirtualLayout(shape=values.shape, dtype="f8")
    layout[:] = h5py.VirtualSource(str(other), "x", shape=values.shape)
    file.create_virtual_dataset(SIGNAL, layout)


def write_external_link(file, values):
    other = Path(file.filename).with_suffix(".other")
    with h5py.File(other, "w") as second:
        second["x"] = values
    file[SIGNAL] = h5py.ExternalLink(str(other), "x")


def write_inner_link(file, values):
    file["y"] = values
    file[SIGNAL] = h5py.SoftLink("/y")


@pytest.mark.parametrize(
    ("signal", "words"),
    [
        (write_external_dataset, "are stored in another file"),
        (write_virtual_dataset, "are stored in another file"),
        (write_external_link, f"'{SIGNAL}' is a link"),
        (write_inner_link, f"'{SIGNAL}' is a link"),
    ],
)
def test_links_and_external_data_raise(tmp_path, signal, words):
    # The checksum would be of the shell alone.
    assert words in read_error_message(write_hdf5(tmp_path / "run.h5", signal))


def test_unused_datasets_are_ignored(tmp_path):
    columns = simulate_columns()
    savemat(tmp_path / "run.mat", {**columns, "s": scipy.sparse.eye(5).tocsc(), "c": {"a": 1.0}})

    def write_dates_and_columns(file, values):
        file[SIGNAL] = values
        # A type that NumPy has not.
        space = h5py.h5s.create_simple((3,))
        h5py.h5d.create(file.id, b"stamp", h5py.h5t.UNIX_D32LE, space)
        file["far"] = h5py.ExternalLink("nowhere.h5", "x")

    write_hdf5(tmp_path / "run.h5", write_dates_and_columns)
    for name in ("run.mat", "run.h5"):
        np.testing.assert_array_equal(
            read_written_record(tmp_path / name).signals["Qx"], columns[SIGNAL]
        )


def test_non_numeric_column_raises_with_name(tmp_path):
    def write_dates(file, values):
        space = h5py.h5s.create_simple(values.shape)
        h5py.h5d.create(file.id, SIGNAL.encode(), h5py.h5t.UNIX_D32LE, space)

    assert f"'{SIGNAL}' does not contain numbers" in read_error_message(
        write_hdf5(tmp_path / "run.h5", write_dates)
    )
    columns = simulate_columns()
    savemat(tmp_path / "run.mat", {**columns, SIGNAL: scipy.sparse.csc_matrix(columns[SIGNAL])})
    assert f"'{SIGNAL}' does not contain numbers" in read_error_message(tmp_path / "run.mat")


def test_columns_in_groups_and_structures_are_read_by_path(tmp_path):
    columns = simulate_columns()
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["other"] = [1.0]
        for name, values in columns.items():
            file[f"run/data/{name}"] = values
    savemat(tmp_path / "five.mat", {"run": {"data": columns, "about": "x"}, "other": 1.0})
    with h5py.File(tmp_path / "seven.mat", "w") as file:
        file["#refs#/a"] = [1.0]
        file["other"] = [1.0]
        for name, values in columns.items():
            file[f"run/data/{name}"] = values[None, :]
    for name, mark in (("a.h5", "/"), ("five.mat", "."), ("seven.mat", ".")):
        path, group = tmp_path / name, f"run{mark}data"
        record = read_written_record(path, dialect=Dialect(group=group))
        np.testing.assert_array_equal(record.signals["Qx"], columns[SIGNAL])
        long = {"time": ColumnSpec(f"{group}{mark}{TIME}"), "angle": None}
        long["signals"] = {"Qx": ColumnSpec(f"{group}{mark}{SIGNAL}")}
        np.testing.assert_array_equal(read_written_record(path, **long).time, columns[TIME])
        assert "no group 'runs' contains columns" in read_error_message(
            path, dialect=Dialect(group="runs")
        )


@pytest.mark.parametrize("name", ["run.mat", "run.h5"])
def test_matrix_is_split_into_columns(tmp_path, name):
    columns = simulate_columns()
    wide = np.stack([columns[ANGLE], columns[SIGNAL]])
    if name == "run.mat":
        rec = {TIME: columns[TIME][:, None], "pos": wide.T, "fs": 50.0, "label": "arm"}
        savemat(tmp_path / name, {"rec": rec})
    else:
        with h5py.File(tmp_path / name, "w") as file:
            file["rec/pos"], file["rec/fs"] = wide, 50.0  # a row is a column too
            file[f"rec/{TIME}"] = columns[TIME]
    mark = "." if name == "run.mat" else "/"
    spec = {"Qx": ColumnSpec(f"pos{mark}2")}
    record = read_written_record(tmp_path / name, angle=ColumnSpec(f"pos{mark}1"), signals=spec)
    np.testing.assert_array_equal(record.signals["Qx"], columns[SIGNAL])
    with open_columns(tmp_path / name) as file:
        assert {f"pos{mark}1", f"pos{mark}2"} <= set(file.names)
        assert "fs" not in file.names
        assert file.single_numbers() == {"fs": 50.0}
    angle = ColumnSpec(f"pos{mark}1")
    error_message = read_error_message(
        tmp_path / name, angle=angle, signals={"Qx": ColumnSpec("pos")}
    )
    assert f"a single column is required: 'pos{mark}1', 'pos{mark}2'" in error_message


def test_matlab_text_file_is_read(tmp_path):
    rows = np.column_stack([simulate_columns()[name] for name in (TIME, ANGLE, SIGNAL)])
    np.savetxt(tmp_path / "run.mat", rows, fmt="  %.16e")
    numbered = {"angle": ColumnSpec("column 2"), "signals": {"Qx": ColumnSpec("column 3")}}
    record = read_written_record(tmp_path / "run.mat", time=ColumnSpec("column 1"), **numbered)
    np.testing.assert_array_equal(record.signals["Qx"], simulate_columns()[SIGNAL])


@pytest.mark.parametrize("key", ["units", "unit"])
def test_attributes_state_unit_scale_and_missing_value(tmp_path, key):
    """NetCDF conventions: integers with scale_factor, add_offset and _FillValue."""
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file["t"] = np.arange(4.0)
        file["t"].attrs[key] = "seconds since 2026-01-01 00:00:00"
        file["east"] = np.array([100, -32768, 300, 400], dtype=np.int16)
        for name, value in (("scale_factor", 0.5), ("add_offset", [7.0]), ("_FillValue", -32768)):
            file["east"].attrs[name] = value
        file["east"].attrs[key] = b"mm"
        file["raw"] = np.arange(4)
        file["raw"].attrs["scale_factor"] = "unknown"
    with open_columns(path, Dialect()) as columns:
        assert columns.units == {"t": "s", "east": "mm", "raw": ""}
        values = columns.read_columns(["t", "east", "raw"])
    np.testing.assert_array_equal(values["east"], [57.0, np.nan, 157.0, 207.0])
    np.testing.assert_array_equal(values["raw"], range(4))
