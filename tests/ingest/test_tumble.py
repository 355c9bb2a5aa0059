"""From a table of readings of a tumble to a description."""

import numpy as np
import pytest
from raising import raises
from workbooks import write_workbook

from counterspin.calibration.calibrate import calibrate
from counterspin.ingest.contents import read_files
from counterspin.ingest.description import make_draft, write_description
from counterspin.ingest.overview import guess_test
from counterspin.ingest.tumble import make_tumble_draft

ANGLES = np.arange(0.0, 360.0, 30.0)
ANSWERS = {"gravity": "9,8066", "latitude": "45.75"}


def make_rows(start=0.0):
    """Return rows of name, deg, mA and u of an accelerometer that points `start` deg from up."""
    force = 0.002 + np.cos(np.radians(ANGLES - start))
    rows = zip(ANGLES.tolist(), (1.25 * force).round(7).tolist(), strict=True)
    return [[f"no {n}", angle, value, 2.5e-6] for n, (angle, value) in enumerate(rows)]


def write_table(path, rows, head=("Name", "Winkel", "Signal", "u"), units=("", "deg", "mA", "mA")):
    lines = ["Tumble 7", ";".join(head), ";".join(units)]
    lines += [";".join(str(cell).replace(".", ",") for cell in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    ("start", "axis"), [(0.0, "up"), (90.0, "west"), (180.0, "down"), (-90.0, "east")]
)
def test_readings_determine_axis_at_zero(tmp_path, start, axis):
    path = write_table(tmp_path / "t.csv", make_rows(start))
    tumble_draft = make_tumble_draft(read_files([path]), ANSWERS | {"Signal sensitivity": "1,25"})
    assert tumble_draft.open_questions == []
    document = tumble_draft.make_document(tmp_path / "camp")
    assert document["accelerometers"]["A"]["input_axis"] == axis
    assert document["readings"]["file"] == "../t.csv"
    write_description(tumble_draft, tmp_path / "camp")
    values = calibrate(tmp_path / "camp").accelerometers["A"].coefficients
    # The Earth's rate is not in these numbers, nor is anything but bias and scale factor.
    assert values["K_F"].value == pytest.approx(0.002, abs=1e-6)
    assert values["K_I"].value == pytest.approx(1.0, abs=1e-6)
    assert abs(values["delta_O"].value) < 1e-5


@pytest.mark.parametrize("start", [0.0, 45.0, 180.0])
def test_short_table_following_positions_is_tumble(tmp_path, start):
    path = write_table(tmp_path / "t.csv", make_rows(start))
    assert guess_test(read_files([path])) == "tumble"


def record_rows(rows):
    """Return the first rows of a record, 30 deg apart: name, deg, value, s."""
    return [
        [f"{angle:g}", angle, np.cos(np.radians(angle)), 0.05 * n]
        for n, angle in enumerate(30.0 * np.arange(rows))
    ]


@pytest.mark.parametrize(
    ("rows", "head", "units"),
    [
        # A time that runs evenly, a path, more rows than anybody sets by hand, noise.
        (record_rows(12), ("Name", "Angle", "Signal", "Time"), ("", "deg", "V", "s")),
        (record_rows(12), ("Name", "Angle", "East", "u"), ("", "deg", "m", "m")),
        (record_rows(101), ("Name", "Angle", "Signal", "u"), ("", "deg", "V", "V")),
        (
            [[f"{n}", 30.0 * n, value, 1e-6] for n, value in enumerate([1, -1, 3, 0, 2, 2, -3, 1])],
            ("Name", "Angle", "Signal", "u"),
            ("", "deg", "V", "V"),
        ),
    ],
)
def test_other_tables_are_not_tumble(tmp_path, rows, head, units):
    path = write_table(tmp_path / "t.csv", rows, head, units)
    assert guess_test(read_files([path])) != "tumble"


@pytest.mark.parametrize("start", [0.0, 90.0, 180.0, -90.0])
def test_directions_follow_from_largest_readings(tmp_path, start):
    path = write_table(tmp_path / "t.csv", make_rows(start))
    directions = np.array(make_tumble_draft(read_files([path])).directions)
    assert np.cos(np.radians(directions)) == pytest.approx(np.cos(np.radians(ANGLES - start)))
    # Right-handed about north, up goes to the east.
    assert np.sin(np.radians(directions)) == pytest.approx(np.sin(np.radians(ANGLES - start)))


def test_directions_require_axis_at_zero(tmp_path):
    path = write_table(tmp_path / "t.csv", make_rows(45.0))
    assert make_tumble_draft(read_files([path])).directions == []
    assert len(make_tumble_draft(read_files([path]), {"axis at 0": "up"}).directions) == len(ANGLES)


def test_workbook_with_title_and_units_is_understood(tmp_path):
    rows = [["Tumble", None], [None, "deg", "V", "V"], *make_rows()]
    rows.insert(1, ["Name", "Position", "Output 1", "Output 2"])
    path = write_workbook(tmp_path / "t.xlsx", {"Notes": [["hello"]], "Readings": rows})
    more = {"Output 1 sensitivity": "1.25 V/g", "Output 2 is": "uncertainty"}
    tumble_draft = make_tumble_draft(read_files([path]), ANSWERS | more)
    assert tumble_draft.roles == {
        "Name": "name",
        "Position": "position",
        "Output 1": "reading",
        "Output 2": "uncertainty",
    }
    write_description(tumble_draft, tmp_path)
    assert calibrate(tmp_path).accelerometers["A"].coefficients["K_I"].estimated


def test_missing_information_is_asked(tmp_path):
    rows = [row[1:3] for row in make_rows()]
    path = write_table(tmp_path / "t.csv", rows, ("a", "b"), ("", ""))
    draft = make_draft(read_files([path]), {}, "tumble")
    keys = [question.key for question in draft.open_questions]
    assert keys == ["gravity", "latitude", "position", "axis at 0", "a unit", "b unit"]
    answers = ANSWERS | {"position": "a", "b unit": "mA"}
    draft = make_draft(read_files([path]), answers, "tumble")
    (last,) = draft.open_questions
    assert last.key == "b sensitivity"
    assert "The data suggest about 1.25 mA/g." in last.text
    with raises("missing-answer", "b sensitivity:"):
        draft.make_document(tmp_path)


def test_table_without_readings_raises(tmp_path):
    path = write_table(tmp_path / "t.csv", make_rows())
    answers = ANSWERS | {"Signal is": "unused", "axis at 0": "up"}
    with raises("missing-column", "columns: Winkel, Signal, u"):
        make_tumble_draft(read_files([path]), answers).make_document(tmp_path)


def test_several_tables_raise(tmp_path):
    path = write_table(tmp_path / "t.csv", make_rows())
    with raises("wrong-usage", "a single file"):
        make_draft(read_files([path, path]), {}, "tumble")
