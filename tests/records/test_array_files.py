"""Record files of HDF5 and MATLAB."""

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.sparse
from record_files import ANGLE, SIGNAL, TIME, read, refusal, table
from scipy.io import savemat

from counterspin.records.dialect import Dialect
from counterspin.records.formats import open_columns
from counterspin.records.record import ColumnSpec


def test_datasets_without_any_space(tmp_path):
    with h5py.File(tmp_path / "run.h5", "w") as file:
        for name in table():
            file[name] = h5py.Empty("f8")
    assert f"'{TIME}' has the shape None; one column is needed" in refusal(tmp_path / "run.h5")


def test_columns_of_different_length(tmp_path):
    with h5py.File(tmp_path / "run.h5", "w") as file:
        for name, values in table().items():
            file[name] = values[: 900 if name == TIME else None]
    assert "length" in refusal(tmp_path / "run.h5")


def bomb(path):
    """Write columns that pack to a thousandth of themselves."""
    zeros = np.zeros(5_000_000)
    if path.suffix == ".mat":
        savemat(path, dict.fromkeys((TIME, ANGLE, SIGNAL), zeros), do_compression=True)
    else:
        with h5py.File(path, "w") as file:
            for name in (TIME, ANGLE, SIGNAL):
                file.create_dataset(name, shape=(10**12,), dtype="f8", chunks=(1000,))
    return path


@pytest.mark.parametrize("name", ["run.mat", "run.h5"])
def test_columns_that_no_file_of_this_size_holds(tmp_path, name):
    message = refusal(bomb(tmp_path / name))
    assert re.search(r"\d+ bytes, .* \d+ bytes", message)


def hdf5(path, signal=None):
    """Write a file whose signal is left to the caller."""
    columns = table()
    with h5py.File(path, "w") as file:
        file[TIME], file[ANGLE] = columns[TIME], columns[ANGLE]
        if signal is not None:
            signal(file, columns[SIGNAL])
    return path


def outside(file, values):
    raw = Path(file.filename).with_suffix(".raw")
    raw.write_bytes(values.tobytes())
    where = [(str(raw), 0, h5py.h5f.UNLIMITED)]
    file.create_dataset(SIGNAL, shape=values.shape, dtype="f8", external=where)


def virtual(file, values):
    other = Path(file.filename).with_suffix(".other")
    with h5py.File(other, "w") as second:
        second["x"] = values
    layout = h5py.VirtualLayout(shape=values.shape, dtype="f8")
    layout[:] = h5py.VirtualSource(str(other), "x", shape=values.shape)
    file.create_virtual_dataset(SIGNAL, layout)


def external_link(file, values):
    other = Path(file.filename).with_suffix(".other")
    with h5py.File(other, "w") as second:
        second["x"] = values
    file[SIGNAL] = h5py.ExternalLink(str(other), "x")


def inner_link(file, values):
    file["y"] = values
    file[SIGNAL] = h5py.SoftLink("/y")


@pytest.mark.parametrize(
    ("signal", "words"),
    [
        (outside, "are in another file"),
        (virtual, "are in another file"),
        (external_link, f"'{SIGNAL}' is a link"),
        (inner_link, f"'{SIGNAL}' is a link"),
    ],
)
def test_numbers_that_stand_elsewhere_are_refused(tmp_path, signal, words):
    # The checksum would be of the shell alone.
    assert words in refusal(hdf5(tmp_path / "run.h5", signal))


def test_what_is_beside_the_columns_does_not_matter(tmp_path):
    columns = table()
    savemat(tmp_path / "run.mat", {**columns, "s": scipy.sparse.eye(5).tocsc(), "c": {"a": 1.0}})

    def with_dates(file, values):
        file[SIGNAL] = values
        # A type that NumPy has not.
        space = h5py.h5s.create_simple((3,))
        h5py.h5d.create(file.id, b"stamp", h5py.h5t.UNIX_D32LE, space)
        file["far"] = h5py.ExternalLink("nowhere.h5", "x")

    hdf5(tmp_path / "run.h5", with_dates)
    for name in ("run.mat", "run.h5"):
        np.testing.assert_array_equal(read(tmp_path / name).signals["Qx"], columns[SIGNAL])


def test_columns_of_other_kinds_are_named(tmp_path):
    def dates(file, values):
        space = h5py.h5s.create_simple(values.shape)
        h5py.h5d.create(file.id, SIGNAL.encode(), h5py.h5t.UNIX_D32LE, space)

    assert f"'{SIGNAL}' does not contain numbers" in refusal(hdf5(tmp_path / "run.h5", dates))
    columns = table()
    savemat(tmp_path / "run.mat", {**columns, SIGNAL: scipy.sparse.csc_matrix(columns[SIGNAL])})
    assert f"'{SIGNAL}' does not contain numbers" in refusal(tmp_path / "run.mat")


def test_columns_of_a_group_or_a_structure_by_path(tmp_path):
    columns = table()
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
        record = read(path, dialect=Dialect(group=group))
        np.testing.assert_array_equal(record.signals["Qx"], columns[SIGNAL])
        long = {"time": ColumnSpec(f"{group}{mark}{TIME}"), "angle": None}
        long["signals"] = {"Qx": ColumnSpec(f"{group}{mark}{SIGNAL}")}
        np.testing.assert_array_equal(read(path, **long).time, columns[TIME])
        assert "no group 'runs' contains columns" in refusal(path, dialect=Dialect(group="runs"))


@pytest.mark.parametrize("name", ["run.mat", "run.h5"])
def test_a_matrix_is_its_columns(tmp_path, name):
    columns = table()
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
    record = read(tmp_path / name, angle=ColumnSpec(f"pos{mark}1"), signals=spec)
    np.testing.assert_array_equal(record.signals["Qx"], columns[SIGNAL])
    with open_columns(tmp_path / name) as file:
        assert {f"pos{mark}1", f"pos{mark}2"} <= set(file.names)
        assert "fs" not in file.names
        assert file.single_numbers() == {"fs": 50.0}
    angle = ColumnSpec(f"pos{mark}1")
    whole = refusal(tmp_path / name, angle=angle, signals={"Qx": ColumnSpec("pos")})
    assert f"one column is needed: 'pos{mark}1', 'pos{mark}2'" in whole


def test_text_that_matlab_saved(tmp_path):
    rows = np.column_stack([table()[name] for name in (TIME, ANGLE, SIGNAL)])
    np.savetxt(tmp_path / "run.mat", rows, fmt="  %.16e")
    numbered = {"angle": ColumnSpec("column 2"), "signals": {"Qx": ColumnSpec("column 3")}}
    record = read(tmp_path / "run.mat", time=ColumnSpec("column 1"), **numbered)
    np.testing.assert_array_equal(record.signals["Qx"], table()[SIGNAL])
