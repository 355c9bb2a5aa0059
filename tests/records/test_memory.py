import hashlib

import numpy as np
import polars as pl
import pytest
from raising import raises

from counterspin.errors import RecordError
from counterspin.records.formats import locate, read_numbers
from counterspin.records.memory import make_memory_table
from counterspin.records.reading import read_record
from counterspin.records.record import ColumnSpec, NominalMotion, RecordColumns

TIMES = [0.0, 0.5, 1.0]
ANGLES = [0.0, 1.0, float("nan")]


class Column:
    """Provide a column like that of pandas, with its missing-value type."""

    def __init__(self, values, dtype=float):
        self.values, self.dtype = values, np.dtype(dtype)

    def to_numpy(self):
        return np.array(self.values, dtype=self.dtype)


class NAType:
    """Represent a missing value of a nullable pandas column."""


class Frame:
    """Provide a frame like that of pandas: `columns` and access by name."""

    def __init__(self, columns):
        self._columns = columns
        self.columns = list(columns)

    def __getitem__(self, name):
        return self._columns[name]


class Stream:
    """Provide a frame through the Arrow stream interface."""

    def __init__(self, frame):
        self._frame = frame

    def __arrow_c_stream__(self, requested_schema=None):
        return self._frame.__arrow_c_stream__(requested_schema)


STRUCTURED = np.array(list(zip(TIMES, ANGLES, strict=True)), dtype=[("t", "f8"), ("a", "f8")])


@pytest.mark.parametrize(
    "frame",
    [
        {"t": TIMES, "a": np.array(ANGLES)},
        {"t": np.array([TIMES]).T, "a": np.ma.masked_invalid(ANGLES)},
        {"t": TIMES, "a": [0, 1, None]},
        pl.DataFrame({"t": TIMES, "a": [0, 1, None]}),
        STRUCTURED,
        Frame({"t": Column(TIMES), "a": Column([0.0, 1.0, NAType()], object)}),
        Stream(pl.DataFrame({"t": TIMES, "a": [0, 1, None]})),
    ],
    ids=["arrays", "masked", "lists", "polars", "structured", "pandas", "arrow"],
)
def test_frames_of_all_libraries_return_same_columns(frame):
    table = make_memory_table("run", frame)
    np.testing.assert_array_equal(table.columns["t"], TIMES)
    np.testing.assert_array_equal(table.columns["a"], ANGLES)
    assert table.non_numeric_names == ()


def test_values_are_copied():
    times = np.array(TIMES)
    table = make_memory_table("run", {"t": times})
    times[0] = 7.0
    assert table.columns["t"][0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        table.columns["t"][0] = 7.0


def test_checksum_covers_names_and_values():
    little = np.array(TIMES, dtype="<f8").tobytes()
    digest = hashlib.sha256(b"t\0" + little).hexdigest()
    assert make_memory_table("run", {"t": TIMES}).checksum == f"sha256:{digest}"
    other = make_memory_table("run", {"t": [0.0, 0.5, np.nextafter(1.0, 2.0)]})
    assert other.checksum != f"sha256:{digest}"


def test_text_column_of_digits_is_not_numeric():
    table = make_memory_table("run", {"t": TIMES, "a": ["1", "2", "3"]})
    assert table.non_numeric_names == ("a",)
    with raises("not-numeric", "run:", "'a'"):
        read_numbers(table, ["t", "a"])


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (7, "run: a int has no named columns. Pass a mapping"),
        ({"t": TIMES, "a": [1.0]}, "run: the columns have different lengths: 't' 3, 'a' 1"),
        ({"t": [], "a": []}, "run: the file has no rows of numbers"),
        ({"t": TIMES, "a": np.zeros((3, 3))}, r"column 'a' has the shape \(3, 3\)"),
    ],
)
def test_unsupported_frame_raises(frame, message):
    with pytest.raises(RecordError, match=message):
        make_memory_table("run", frame)


COLUMNS = RecordColumns(ColumnSpec("t"), ColumnSpec("a"), {"Qx": ColumnSpec("s")})


def make_samples(rows=400):
    time = np.arange(rows) * 0.1
    return {"t": time, "a": time, "s": np.random.default_rng(1).normal(size=rows)}


def test_record_in_memory_equals_record_from_file(tmp_path):
    frame = make_samples()
    pl.DataFrame(frame).write_csv(tmp_path / "run.csv")
    motion = NominalMotion(1.0)
    of_file = read_record(tmp_path / "run.csv", COLUMNS, motion)
    in_memory = read_record(make_memory_table("run", frame), COLUMNS, motion)
    np.testing.assert_array_equal(in_memory.signals["Qx"], of_file.signals["Qx"])
    np.testing.assert_array_equal(in_memory.angle, of_file.angle)
    assert in_memory.identity is None


def test_errors_name_row():
    frame = make_samples()
    frame["t"][200] = 3.0
    with raises("time-backwards", "my run, row 201:"):
        read_record(make_memory_table("my run", frame), COLUMNS, NominalMotion(1.0))
    with raises("missing-column", "'s'", "'t'", "'a'"):
        read_record(
            make_memory_table("my run", {"t": [1.0], "a": [1.0]}), COLUMNS, NominalMotion(1.0)
        )
    assert locate(make_memory_table("my run", frame), 4) == "row 5"
