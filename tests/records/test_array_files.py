"""Record files of HDF5 and MATLAB."""

import h5py
from record_files import TIME, refusal, table


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
