"""Files of many makes: each is read as the same record, or refused with what to do."""

import numpy as np
import polars as pl
import pytest
from raising import raises
from recorders import FILES

from counterspin.calibration.observed_runs import read_run
from counterspin.campaign.description import read_campaign
from counterspin.errors import CounterspinError
from counterspin.ingest.contents import read_files
from counterspin.ingest.description import make_turntable_draft, write_description
from counterspin.ingest.overview import describe_files

RATE = 2.0 * np.pi
#: Cells that have no number.
MISSING = {"cells that were not measured": {"Qx": 3, "Qy": 1}}
KNOWN = {"gravity": "9.8066 m/s^2", "latitude": "45.75 deg", "radius": "2.5 m"}


@pytest.fixture(scope="module")
def recorded_frame():
    """Return a run of 20 turns: a circle of 2.5 m, and noise of 1 cm."""
    time = np.arange(400) * 0.05
    noise = np.random.default_rng(5).normal(scale=0.01, size=(2, 400))
    angle = RATE * time
    waves = {"east_m": 2.5 * np.cos(angle) + noise[0], "north_m": 2.5 * np.sin(angle) + noise[1]}
    return pl.DataFrame({"time_s": time, "angle_rad": angle, **waves})


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_recorder_formats_return_same_campaign(tmp_path, recorded_frame, name):
    write, ending = FILES[name]
    path = tmp_path / f"run{ending}"
    write(recorded_frame, path)
    turntable_draft = make_turntable_draft(read_files([path]), KNOWN)
    assert [question.key for question in turntable_draft.open_questions] == []
    write_description(turntable_draft, tmp_path / "campaign")
    campaign = read_campaign(tmp_path / "campaign")
    (run,) = campaign.runs
    assert run.rate == pytest.approx(RATE, rel=1e-6)
    record = read_run(campaign, run)
    assert record.time - record.time[0] == pytest.approx(
        recorded_frame["time_s"].to_numpy(), abs=1e-6
    )
    assert record.angle == pytest.approx(recorded_frame["angle_rad"].to_numpy(), abs=3e-6)
    for owner, column in (("Qx", "east_m"), ("Qy", "north_m")):
        measured = np.isfinite(record.signals[owner])
        assert np.count_nonzero(~measured) == MISSING.get(name, {}).get(owner, 0)
        expected = recorded_frame[column].to_numpy()[measured]
        assert record.signals[owner][measured] == pytest.approx(expected, abs=1e-6)


def test_sense_is_found_along_west_and_south(tmp_path, recorded_frame):
    angle = (90.0 - np.degrees(recorded_frame["angle_rad"].to_numpy())) % 360.0
    data = {
        "t_s": recorded_frame["time_s"],
        "azimuth_deg": angle,
        "west_m": -recorded_frame["east_m"],
    }
    path = tmp_path / "run.csv"
    pl.DataFrame(data | {"south_m": -recorded_frame["north_m"]}).write_csv(path)
    document = make_turntable_draft(read_files([path]), KNOWN).make_document(tmp_path)
    assert (
        document["records"]["angle"] | {"zero": "north", "sense": "clockwise"}
        == (document["records"]["angle"])
    )
    assert [
        accelerometer["input_axis"] for accelerometer in document["accelerometers"].values()
    ] == ["west", "south"]


def lines(path, head, rows):
    path.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("head", "row", "message"),
    [
        (["Time;Angle;East"], "at {t};{a} or so;{e}?", "line 2: 3 cells, none a number.*numeric"),
        ([], '{{"t": {t}, "angle": {a}, "east": {e}}}', "line 1.*Export one column"),
        (
            ["VarName;Time_s;VarValue"],
            "Angle;{t};{a}\nEast;{t};{e}",
            "the values in column 'VarName' alternate between Angle, East",
        ),
    ],
)
def test_unsupported_layout_raises_with_remedy(tmp_path, recorded_frame, head, row, message):
    cells = zip(*(recorded_frame[name] for name in ("time_s", "angle_rad", "east_m")), strict=True)
    rows = [row.format(t=t, a=a, e=e) for t, a, e in cells]
    with pytest.raises(CounterspinError, match=f"(?s){message}"):
        make_turntable_draft(read_files([lines(tmp_path / "run.csv", head, rows)])).make_document(
            tmp_path
        )


def test_single_row_per_quantity_raises(tmp_path, recorded_frame):
    rows = [f"{name};{';'.join(map(str, recorded_frame[name]))}" for name in recorded_frame.columns]
    with pytest.raises(CounterspinError, match=r"has \d rows of .* one row per sample"):
        make_turntable_draft(read_files([lines(tmp_path / "run.csv", [], rows)])).make_document(
            tmp_path
        )


@pytest.mark.parametrize("below", ["End of data", "Mean,1.0,2.0,3.0\nChecked by: J. D."])
def test_footer_lines_are_ignored_and_reported(tmp_path, recorded_frame, below):
    path = tmp_path / "run.csv"
    recorded_frame.write_csv(path)
    rows = path.read_text()
    path.write_text(f"{rows}{below}\n")
    contents = read_files([path])
    count = below.count("\n") + 1
    text = "the last line was ignored" if count == 1 else f"the last {count} lines were ignored"
    assert any(text in line for line in describe_files(contents))
    document = make_turntable_draft(contents, KNOWN).make_document(tmp_path)
    assert document["runs"][0]["records"] == {"skip_footer": count}
    path.write_text(rows)
    assert (
        make_turntable_draft(read_files([path]), KNOWN).make_document(tmp_path)["records"]
        == document["records"]
    )


def test_repeated_header_raises_with_line(tmp_path, recorded_frame):
    recorded_frame.write_csv(tmp_path / "run.csv")
    rows = (tmp_path / "run.csv").read_text()
    path = lines(tmp_path / "twice.csv", [rows.rstrip()], [rows.rstrip()])
    with raises("not-numeric", "line 402", "'time_s'"):
        read_files([path])


def test_rows_are_counted_for_clock_of_one_second_resolution(tmp_path, recorded_frame):
    stamps = [f"2026-01-12 10:59:{int(t):02d}" for t in recorded_frame["time_s"]]
    path = tmp_path / "run.csv"
    recorded_frame.with_columns(time_s=pl.Series(stamps)).write_csv(path)
    (question,) = (
        q for q in make_turntable_draft(read_files([path])).questions if q.key == "sampling_rate"
    )
    assert question.guess == "20 Hz"
    statements = " ".join(make_turntable_draft(read_files([path])).statements)
    assert (
        "20 rows per second, calculated from the row count, because several rows have the same "
        "time in "
        "column 'time_s'" in statements
    )


def test_header_of_second_run_raises_with_line(tmp_path):
    rows = [f"{0.05 * k:.2f},{k},{k % 7}" for k in range(500)]
    head = ["Run 1", "Time [s],Angle [deg],East [m]"]
    path = lines(tmp_path / "all.csv", head, [*rows, "Run 2", head[1], *rows])
    with raises("not-numeric", "line 503", "'Run 2'"):
        read_files([path])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xd0\xcf\x11\xe0", "this workbook"),
        (b"<html><table>", "a web page or an XML spreadsheet"),
    ],
)
def test_old_workbook_format_raises_with_remedy(tmp_path, content, message):
    (tmp_path / "run.xls").write_bytes(content + bytes(600))
    with pytest.raises(CounterspinError, match=f"{message}.*save it as .xlsx"):
        read_files([tmp_path / "run.xls"])
