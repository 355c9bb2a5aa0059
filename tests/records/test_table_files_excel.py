"""Workbooks of Excel as tables, read where they can do no harm."""

import builtins
import sys
import zipfile

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
)
from workbooks import write_workbook

from counterspin.campaign.description import read_campaign
from counterspin.errors import DamagedFileError
from counterspin.ingest.contents import read_files
from counterspin.ingest.description import make_draft, write_description
from counterspin.ingest.overview import guess_test
from counterspin.records.dialect import Dialect
from counterspin.records.formats import read_small_table
from counterspin.records.isolation import uses_reader_process
from counterspin.records.record import ColumnSpec
from counterspin.records.table_files import find_table_sheets, read_excel_table

ROWS = [
    ["position", "deg", "mA"],
    ["a", 0, 1.25],
    ["b", 30.5, "1.0 mA"],
    ["c", 60, 1 / 3],
    [None, 90, 1e-13],
]


def test_sheet_has_names_numbers_and_text(tmp_path):
    path = write_workbook(tmp_path / "r.xlsx", {"Notes": [["hello"]], "Tumble": ROWS})
    assert uses_reader_process(path)
    for sheet in (None, "Tumble"):  # the other one has no rows below its names
        table = read_small_table(path, Dialect(sheet=sheet))[0].frame
        assert table.columns == ROWS[0]
        assert table["deg"].to_list() == [0.0, 30.5, 60.0, 90.0]
        # To the last digit, though a column of text and numbers is one of text.
        assert [float(table["mA"][i]) for i in (0, 2, 3)] == [1.25, 1 / 3, 1e-13]
        assert table["mA"][1] == "1.0 mA"
        assert table["position"].to_list() == ["a", "b", "c", None]
    assert read_small_table(path)[1][1] == "row 2 below the names"


def test_ambiguous_or_unknown_sheet_raises(tmp_path):
    path = write_workbook(tmp_path / "r.xlsx", {"before": ROWS, "after": ROWS})
    with raises("ambiguous-selection", "'before'", "'after'"):
        read_small_table(path)
    with raises("unknown-sheet", "'aftr'", "'before'", "'after'"):
        read_small_table(path, Dialect(sheet="aftr"))


def test_damaged_workbook_raises(tmp_path):
    path = write_workbook(tmp_path / "r.xlsx", {"Tumble": ROWS})
    path.write_bytes(path.read_bytes()[:600])
    with raises("file-damaged", "r.xlsx:"):
        read_small_table(path)


def test_oversized_workbook_raises_before_decompression(tmp_path, monkeypatch):
    monkeypatch.setattr("counterspin.records.table_files._UNPACKED_BYTES", 1_000_000)
    path = write_workbook(tmp_path / "r.xlsx", {"Tumble": ROWS})
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as file:
        file.writestr("xl/sharedStrings.xml", bytes(3_000_000))
    with raises("file-too-large", "r.xlsx:", "3 MB", "1 MB"):
        read_excel_table(path)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits are Linux's")
def test_distant_cell_exceeds_memory_limit(tmp_path):
    path = write_workbook(tmp_path / "r.xlsx", {"Tumble": ROWS}, {"B5": "XFD1048576"})
    with pytest.raises(DamagedFileError, match="needs more memory than allowed"):
        read_small_table(path)


def test_missing_reader_raises_with_extra(tmp_path, monkeypatch):
    path = write_workbook(tmp_path / "r.xlsx", {"Tumble": ROWS})
    imported = builtins.__import__

    def import_without_reader(name, *args, **kwargs):
        if name == "fastexcel":
            raise ModuleNotFoundError(name)
        return imported(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", import_without_reader)
    with raises("missing-package", "`pip install '.[excel]'"):
        read_excel_table(path)


def test_sheet_is_read_as_record(tmp_path):
    """The sheet has rows above the names, a units row, an empty cell and text time stamps."""
    columns = simulate_columns(n=400)
    stamps = [f"2026-03-01 12:00:{t:09.6f}" for t in columns[TIME]]
    rows = list(
        map(list, zip(stamps, columns[ANGLE].tolist(), columns[SIGNAL].tolist(), strict=True))
    )
    rows[7][2] = None
    head = [["about", None, None], [None] * 3, [TIME, ANGLE, SIGNAL], [None, "rad", "m"]]
    path = write_workbook(tmp_path / "r.xlsx", {"Notes": [["x"]], "Run": [*head, *rows]})
    time = ColumnSpec(TIME, kind="stamps")
    record = read_written_record(path, time=time)
    np.testing.assert_allclose(record.time, columns[TIME], atol=1e-6)
    expected = np.where(np.arange(400) == 7, np.nan, columns[SIGNAL])
    np.testing.assert_array_equal(record.signals["Qx"], expected)
    assert record.report.format_description == "sheet 'Run', names in row 3, a units row"
    rows[200][1] = "oops"
    write_workbook(path, {"Run": [*head, *rows]})
    assert f"row 205: column '{ANGLE}' contains the text 'oops'" in read_error_message(
        path, time=time
    )
    write_workbook(path, {"Run": [["only", "words"]] * 5})
    assert "no rows of numbers" in read_error_message(path)


def test_only_sheet_with_numeric_rows_is_read(tmp_path):
    notes = [["Operator", "Smith"], ["Day", "Monday"], ["Room", "7"]]
    below = [[name, 30.0 * row, 1.25] for row, name in enumerate("abcd")]
    rows = [["Tumble", None], [None, None], [None, "deg", "mA"], *below]
    path = write_workbook(tmp_path / "r.xlsx", {"Protocol": notes, "Values": rows})
    assert find_table_sheets(path) == ["Values"]
    filed, places, _ = read_small_table(path)
    assert filed.frame["deg"].to_list() == [0.0, 30.0, 60.0, 90.0]
    assert places[1] == "row 5"


def test_rows_below_table_of_sheet_are_ignored(tmp_path):
    angle = np.arange(0.0, 360.0, 30.0)
    output = (1.25 * np.cos(np.radians(angle)) + 0.003).tolist()
    rows = [
        ["position", "out"],
        ["deg", "mA"],
        *map(list, zip(angle.tolist(), output, strict=True)),
    ]
    below = [["Mean", 0.003], [None, None], ["Checked by", "J. D."]]
    path = write_workbook(tmp_path / "t.xlsx", {"Data": [*rows, *below]})
    contents = read_files([path])
    assert contents[0].footer == ("Mean; 0.003", "", "Checked by; J. D.")
    assert [len(column.values) for column in contents[0].columns] == [12, 12]
    assert guess_test(contents) == "tumble"
    answers = {"gravity": "9.81", "latitude": "48", "out sensitivity": "1.25"}
    draft = make_draft(contents, answers, "tumble")
    campaign = read_campaign(write_description(draft, tmp_path / "camp"))
    assert len(campaign.readings) == 12
