"""Record files of every format."""

import h5py
import numpy as np
import pytest
from record_files import ANGLE, SIGNAL, TIME, read, refusal, table, write
from scipy.io import savemat

from counterspin.records.record import ColumnSpec


def test_every_format_gives_the_same_record(tmp_path):
    columns = table()
    paths = [write(tmp_path / "a.csv", columns), write(tmp_path / "a.parquet", columns)]
    with h5py.File(tmp_path / "root.h5", "w") as file:
        for name, values in columns.items():
            file[name] = values
    with h5py.File(tmp_path / "group.hdf5", "w") as file:
        for name, values in columns.items():
            file[f"run/{name}"] = values
    savemat(tmp_path / "five.mat", columns, oned_as="row")
    with h5py.File(tmp_path / "seven.mat", "w") as file:  # MATLAB writes columns as (1, n)
        for name, values in columns.items():
            file[name] = values[None, :]
    paths += [tmp_path / name for name in ("root.h5", "group.hdf5", "five.mat", "seven.mat")]
    first, *others = [read(path) for path in paths]
    np.testing.assert_array_equal(first.time, columns[TIME])
    np.testing.assert_array_equal(first.angle, columns[ANGLE])
    np.testing.assert_array_equal(first.signals["Qx"], columns[SIGNAL])
    for other in others:
        np.testing.assert_array_equal(other.time, first.time)
        np.testing.assert_array_equal(other.signals["Qx"], first.signals["Qx"])


def test_missing_file_directory_and_unknown_kind(tmp_path):
    assert "no such file" in refusal(tmp_path / "none.csv")
    (tmp_path / "folder.csv").mkdir()
    assert "directory" in refusal(tmp_path / "folder.csv")
    assert ".parquet" in refusal(tmp_path / "run.xlsx")


@pytest.mark.parametrize("name", ["run.csv", "run.parquet", "run.h5", "run.mat"])
def test_empty_and_damaged_files(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"")
    assert "empty" in refusal(path)
    path.write_bytes(b"\x00\x01 this is not a record \xff" * 40)
    refusal(path)


@pytest.mark.parametrize("name", ["run.csv", "run.parquet"])
def test_missing_column_lists_those_present(tmp_path, name):
    path = write(tmp_path / name, table())
    message = refusal(path, signals={"Qx": ColumnSpec("eastt_m")})
    assert "'eastt_m'" in message
    assert f"'{TIME}', '{ANGLE}', '{SIGNAL}'" in message
    assert "Did you mean 'east_m'?" in message
