"""Record files of every format."""

import os
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from raising import raises
from record_files import (
    ANGLE,
    SIGNAL,
    TIME,
    read_error_message,
    read_written_record,
    simulate_columns,
    write_record,
)
from scipy.io import savemat

from counterspin.errors import DamagedFileError, RecordError
from counterspin.records.column_file import ColumnFile
from counterspin.records.formats import open_columns
from counterspin.records.record import ColumnSpec


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("run.csv.gz", "the file is compressed; unpack it and use the extracted file."),
        ("runs.ZIP", "the file is compressed; unpack it"),
        (
            "run.doc",
            "this format is not supported; "
            "save the table as .xlsx or .csv in the program that wrote the file.",
        ),
        (
            "run.NPY",
            "NumPy's binary format is not supported; write it as text: "
            'savetxt("NAME.csv", load("NAME.npy"), delimiter',
        ),
        ("run.npz", "NumPy's binary format is not supported; write an array as text: savetxt("),
        ("run.json", "not a data table; export the data as CSV with one line per sample."),
        ("run.pkl", "the byte layout of this file is unknown; export a text file,"),
        ("run.odd", "the name of a record file must end in one of .csv, .txt,"),
    ],
)
def test_unsupported_format_raises_with_remedy(name, words, tmp_path):
    (tmp_path / name).write_bytes(b"\x1f\x8b")
    with pytest.raises(RecordError) as caught:
        open_columns(tmp_path / name)
    assert str(caught.value).startswith(f"{tmp_path / name}: {words}")


def test_all_formats_return_same_record(tmp_path):
    columns = simulate_columns()
    paths = [
        write_record(tmp_path / "a.csv", columns),
        write_record(tmp_path / "a.parquet", columns),
    ]
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
    first, *others = [read_written_record(path) for path in paths]
    np.testing.assert_array_equal(first.time, columns[TIME])
    np.testing.assert_array_equal(first.angle, columns[ANGLE])
    np.testing.assert_array_equal(first.signals["Qx"], columns[SIGNAL])
    for other in others:
        np.testing.assert_array_equal(other.time, first.time)
        np.testing.assert_array_equal(other.signals["Qx"], first.signals["Qx"])


def test_missing_file_directory_and_unknown_format_raise(tmp_path):
    assert "file not found" in read_error_message(tmp_path / "none.csv")
    (tmp_path / "folder.csv").mkdir()
    assert "directory" in read_error_message(tmp_path / "folder.csv")
    assert ".parquet" in read_error_message(tmp_path / "run.odd")


@pytest.mark.parametrize("name", ["run.csv", "run.parquet", "run.h5", "run.mat"])
def test_empty_file_raises(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"")
    assert "empty" in read_error_message(path)
    path.write_bytes(b"\x00\x01 this is not a record \xff" * 40)
    read_error_message(path)


@pytest.mark.parametrize("name", ["run.csv", "run.parquet"])
def test_missing_column_raises_with_available_columns(tmp_path, name):
    path = write_record(tmp_path / name, simulate_columns())
    message = read_error_message(path, signals={"Qx": ColumnSpec("eastt_m")})
    assert "'eastt_m'" in message
    assert f"'{TIME}', '{ANGLE}', '{SIGNAL}'" in message
    assert "Did you mean 'east_m'?" in message


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".h5", ".mat"])
@pytest.mark.parametrize("names", [("run[1]", "run1"), ("run*", "runs"), ("run?", "runs")])
def test_file_name_is_not_glob_pattern(tmp_path, suffix, names):
    # Beside it stands a file that the pattern would match.
    for name, n in zip(names, (1000, 2000), strict=True):
        write_record(tmp_path / f"{name}{suffix}", simulate_columns(n=n))
    assert len(read_written_record(tmp_path / f"{names[0]}{suffix}").time) == 1000
    (tmp_path / f"{names[0]}{suffix}").unlink()
    assert "file not found" in read_error_message(tmp_path / f"{names[0]}{suffix}")


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".h5"])
def test_folder_name_is_not_glob_pattern(tmp_path, suffix):
    for name, n in (("camp[1]", 1000), ("camp1", 2000)):
        (tmp_path / name).mkdir()
        write_record(tmp_path / name / f"run{suffix}", simulate_columns(n=n))
    assert len(read_written_record(tmp_path / "camp[1]" / f"run{suffix}").time) == 1000


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes among the files here")
@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".h5", ".mat"])
def test_pipe_and_device_raise(tmp_path, suffix):
    os.mkfifo(tmp_path / f"run{suffix}")
    assert "this is a pipe, not a file" in read_error_message(tmp_path / f"run{suffix}")
    (tmp_path / f"zero{suffix}").symlink_to("/dev/zero")
    assert "this is a device, not a file" in read_error_message(tmp_path / f"zero{suffix}")


@pytest.mark.parametrize("name", ["a\0b.csv", "a\0b.parquet", "x" * 300 + ".h5"])
def test_invalid_file_name_raises(tmp_path, name):
    assert "cannot be read" in read_error_message(tmp_path / name)


@pytest.mark.skipif(sys.platform != "linux", reason="names are text elsewhere")
@pytest.mark.parametrize(
    ("suffix", "readable"), [(".csv", False), (".parquet", False), (".h5", True)]
)
def test_non_utf8_folder_is_read_or_raises(tmp_path, suffix, readable):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff"))
    folder.mkdir()
    write_record(tmp_path / f"run{suffix}", simulate_columns()).rename(folder / f"run{suffix}")
    if readable:
        assert len(read_written_record(folder / f"run{suffix}").time) == 1000
    else:
        assert "the path is not valid UTF-8" in read_error_message(folder / f"run{suffix}")


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".h5"])
@pytest.mark.parametrize("how", ["replaced", "rewritten"])
def test_file_changed_during_reading_raises(tmp_path, suffix, how):
    path = write_record(tmp_path / f"run{suffix}", simulate_columns())
    other = write_record(tmp_path / f"other{suffix}", simulate_columns(n=2000))
    file = open_columns(path)
    with file:
        pass
    file = open_columns(path)
    if how == "replaced":
        other.replace(path)
    else:
        path.write_bytes(other.read_bytes())
    with raises("file-changed"), file:
        pass


@pytest.mark.parametrize(
    # After a damaged file of these formats the reader's process is started again.
    ("suffix", "files"),
    [(".csv", 40), (".parquet", 8), (".h5", 8), (".mat", 4)],
)
def test_damaged_files_raise_only_record_errors(tmp_path, suffix, files):
    whole = write_record(tmp_path / f"whole{suffix}", simulate_columns(n=400)).read_bytes()
    rng = np.random.default_rng(7)
    path = tmp_path / f"run{suffix}"
    messages = []
    for _ in range(files):
        content = bytearray(whole)
        for place in rng.integers(0, len(content), rng.integers(1, 6)):
            content[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(content[: rng.integers(1, len(content)) if rng.random() < 0.2 else None])
        try:
            read_written_record(path)
        except RecordError as error:
            messages.append(str(error))
    assert messages
    assert all(message.startswith(str(path)) for message in messages)


@pytest.mark.parametrize(
    "error", [KeyError("x"), OverflowError(), RuntimeError("a\nb"), MemoryError(), OSError("no")]
)
def test_reader_errors_name_file_and_last_row(tmp_path, error):
    class Failing(ColumnFile):
        def _require(self, wanted):
            raise error

        def _batches(self, wanted):
            yield {"a": np.zeros(12)}
            raise error

        def _table(self):
            raise error

    path = tmp_path / "run.csv"
    path.write_text("a\n", "utf-8")
    with path.open("rb") as stream, Failing(path, stream) as file:
        file.names = ["a"]
        for call in (lambda: file.require(["a"]), file.table):
            with pytest.raises(DamagedFileError, match=r"run\.csv: (reading )?the file"):
                call()
        with pytest.raises(DamagedFileError, match=r"run\.csv: .* after row 12"):
            list(file.batches(["a"]))


@pytest.mark.parametrize("name", ["run.csv", "run.h5"])
def test_invalid_polars_thread_count_raises(name, monkeypatch, tmp_path):
    path = tmp_path / name
    path.write_bytes(b"")
    monkeypatch.setenv("POLARS_MAX_THREADS", "0")
    with raises("wrong-usage", "POLARS_MAX_THREADS:", "'0'"):
        open_columns(path)
    monkeypatch.setenv("POLARS_MAX_THREADS", "04")
    with pytest.raises(RecordError, match="the file is empty"):
        open_columns(path)
