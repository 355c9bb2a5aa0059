"""What is in a file before anybody says what it means."""

import re

import h5py
import numpy as np
import pytest
from prose import ROOT
from raising import raises
from workbooks import write_workbook

from counterspin.errors import RecordError
from counterspin.ingest.contents import read_contents, read_files

#: The numbers of the example: time, angle, east.
EXAMPLE = [[0.0, 0.02, 0.04], [0.0, 0.18, 0.36], [2.5, 2.499, 2.495]]


def test_columns_have_units_and_time_stamps(tmp_path):
    rows = [f"12:00:0{i},5;{i},25;ok;{'' if i else '7'}" for i in range(8)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["About", "t;x [mm];note;few", *rows]) + "\n")
    seen = read_contents(path)
    assert [(c.name, c.unit, c.is_timestamp) for c in seen.columns] == [
        ("t", "", True),
        ("x [mm]", "mm", False),
        ("few", "", False),
    ]
    np.testing.assert_allclose(seen.columns[0].values, np.arange(8.0), atol=1e-9)
    np.testing.assert_allclose(seen.columns[1].values, np.arange(8) + 0.25)
    assert np.isfinite(seen.columns[2].values).sum() == 1
    assert seen.text_columns == ("note",)


def test_documented_example_is_read_without_description(tmp_path):
    page = (ROOT / "docs" / "exports.md").read_text("utf-8")
    (text,) = re.findall(r"^```\n(Test 12;.*?)^```$", page, re.MULTILINE | re.DOTALL)
    (tmp_path / "a.txt").write_text(text, encoding="utf-8")
    time, angle, east = read_contents(tmp_path / "a.txt").columns
    assert [(c.name, c.unit) for c in (time, angle, east)] == [
        ("Time", "s"),
        ("Angle", "deg"),
        ("East", "m"),
    ]
    np.testing.assert_array_equal([c.values for c in (time, angle, east)], EXAMPLE)


def test_file_without_numbers_raises(tmp_path):
    (tmp_path / "a.csv").write_text("a,b\nx,y\n")
    with pytest.raises(RecordError) as caught:
        read_contents(tmp_path / "a.csv")
    message = str(caught.value)
    assert (
        "no column contains only numbers. First lines of the file:\n  line 1: 2 cells, none"
        in message
    )


def test_line_with_too_many_cells_raises(tmp_path):
    rows = [f"{0.02 * n:.2f},{n % 7}.5" for n in range(60)]
    rows[40] += ",3"
    (tmp_path / "a.csv").write_text("\n".join(["time_s,a_m", *rows, ""]))
    with raises("malformed-table", "a.csv", "line 42", "3 cells"):
        read_contents(tmp_path / "a.csv")


def test_error_codes_of_numbers_are_empty_cells(tmp_path):
    rows = [f"{0.02 * n:.2f},{n % 7}.5" for n in range(60)]
    rows[40:43] = ["0.80,1.#QNAN", "0.82,-1.#IND", "0.84,#DIV/0!"]
    (tmp_path / "a.csv").write_text("\n".join(["time_s,a_m", *rows, ""]))
    values = read_contents(tmp_path / "a.csv").columns[1].values
    assert np.flatnonzero(np.isnan(values)).tolist() == [40, 41, 42]


def test_text_column_is_skipped_and_repeated_header_raises(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time_s"], file["status"] = np.arange(60) * 0.02, np.array([b"ok"] * 60)
    contents = read_contents(tmp_path / "a.h5")
    assert ([column.name for column in contents.columns], contents.text_columns) == (
        ["time_s"],
        ("status",),
    )
    rows = [f"0x68,{0.02 * n:.2f},{n % 7}.5" for n in range(60)]
    rows[30] = "sensor,time_s,a_m"
    (tmp_path / "a.csv").write_text("\n".join([rows[30], *rows, ""]))
    with pytest.raises(
        RecordError, match=r"a\.csv, line 32: .* The header row occurs more than once"
    ):
        read_contents(tmp_path / "a.csv")


def test_sheets_are_runs_unless_sheet_is_chosen(tmp_path):
    rows = [["t [s]", "x"], *[[i / 50, i % 7] for i in range(9)]]
    path = write_workbook(tmp_path / "a.xlsx", {"slow": rows, "fast": rows, "empty": []})
    (first,) = read_files([path])
    assert (first.sheet, first.sheets) == ("slow", ("slow", "fast"))
    assert [file.sheet for file in read_files([path], {"sheet": "fast"})] == ["fast"]
    assert [file.sheet for file in read_files([path], {"sheet": "all"})] == ["slow", "fast"]
    assert read_files([write_workbook(tmp_path / "b.xlsx", {"one": rows})])[0].sheet is None
