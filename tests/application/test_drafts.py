"""Drafts of campaigns from uploaded exports: detection, questions and the campaign."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from exports import EXPORTS, simulate_campaign, write_records
from posed_files import write_compound_file, write_waveform_file
from served import ANSWERS

from counterspin.application.drafts import UNIT_CHOICES, make_detrended_curve
from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.description import read_campaign
from counterspin.ingest.column_roles import guess_file
from counterspin.ingest.contents import FileColumn, FileContents, read_files
from counterspin.ingest.description import make_turntable_draft, write_description
from counterspin.units import is_convertible

RUNS = ("slow", "middle", "fast")
COUNTED = {"sampling_rate": "20 Hz"}


def upload(page, name, content, **more):
    return page.post("/api/files", params={"name": name}, content=content, **more)


@pytest.fixture
def uploaded(page, folder):
    """Return the names of three records uploaded into a new folder."""
    contents = [(folder / "three" / f"{run}.csv").read_bytes() for run in RUNS]
    responses = [
        upload(page, f"new/{run}.csv", c).json() for run, c in zip(RUNS, contents, strict=True)
    ]
    assert [response["bytes"] for response in responses] == list(map(len, contents))
    for run, content in zip(RUNS, contents, strict=True):
        assert (folder / "new" / f"{run}.csv").read_bytes() == content
    return [response["name"] for response in responses]


def test_uploaded_files_become_campaign(page, folder, uploaded):
    body = page.post("/api/draft", json={"names": uploaded}).json()
    assert any("time_s" in statement for statement in body["statements"])
    assert {"gravity", "latitude", "radius"} <= {question["key"] for question in body["questions"]}
    request = {"folder": "new", "names": uploaded}
    unanswered = page.post("/api/drafted", json=request)
    assert unanswered.status_code == 422
    assert any(problem.startswith("radius: ") for problem in unanswered.json()["problems"])
    needed = [question for question in body["questions"] if question["guess"] is None]
    answers = {entry["key"]: entry["example"] for entry in needed} | ANSWERS
    data = page.post("/api/drafted", json=request | {"answers": answers}).json()
    assert data["command"].startswith("counterspin init ")
    campaign = read_campaign(folder / "new")
    rates = [run.rate for run in read_campaign(folder / "three").runs]
    assert [run.rate for run in campaign.runs] == pytest.approx(rates, rel=1e-3)


@pytest.fixture(scope="module")
def plain_folder(tmp_path_factory):
    return simulate_campaign(tmp_path_factory.mktemp("exports"))


def calibrate_from_page(page, folder, files, sense="counterclockwise"):
    """Upload files, answer the questions and return K_II of the resulting campaign."""
    names = [upload(page, f"lab/{f.name}", f.read_bytes()).json()["name"] for f in files]
    questions = page.post("/api/draft", json={"names": names}).json()["questions"]
    known = ANSWERS | COUNTED | {"sense": sense}
    needed = [question for question in questions if question["guess"] is None]
    answers = {entry["key"]: known.get(entry["key"], entry["example"]) for entry in needed}
    request = {"folder": "lab", "names": names, "answers": answers}
    response = page.post("/api/drafted", json=request)
    assert response.status_code == 200, response.json()
    return calibrate(folder / "lab").accelerometers["Qx"].coefficients["K_II"]


@pytest.fixture(scope="module")
def reference(plain_folder, tmp_path_factory):
    """Return K_II of the plain records with the same answers."""
    looks = read_files([plain_folder / "slow.csv", plain_folder / "fast.csv"])
    place = tmp_path_factory.mktemp("plain")
    write_description(make_turntable_draft(looks, ANSWERS | {"sense": "counterclockwise"}), place)
    return calibrate(place).accelerometers["Qx"].coefficients["K_II"]


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPORTS)
def test_result_is_independent_of_export_format(
    page, folder, plain_folder, reference, name, tmp_path
):
    files = write_records(plain_folder, tmp_path / "files", EXPORTS[name])
    sense = "clockwise" if "clockwise" in name else "counterclockwise"
    result = calibrate_from_page(page, folder, files, sense)
    assert abs(result.value - reference.value) < 0.01 * reference.u


def draft_columns(page, names, **more):
    body = page.post("/api/draft", json={"names": names, **more}).json()
    return body, {column["name"]: column for column in body["columns"]}


def test_draft_shows_columns_and_problems(page, uploaded):
    actual_columns, columns = draft_columns(page, uploaded)
    assert list(columns)[:2] == ["time_s", "angle_rad"]
    assert {len(column["first"]) for column in columns.values()} == {4}
    time, angle, east = (columns[name]["curve"] for name in ("time_s", "angle_rad", "east_m"))
    # Times have equal steps; an angle at constant rate is a straight line.
    assert (time["words"], time["size"]) == ("row-to-row step", pytest.approx(0.0, abs=1e-9))
    assert angle["words"] == "straight line removed"
    assert angle["size"] < 1e-3
    # The harmonic has the radius of 2.5 m as amplitude, after removal of a parabola.
    assert east["words"] == "parabola removed, first 4 revolutions"
    assert (east["unit"], east["size"]) == ("m", pytest.approx(2.5, rel=0.05))
    low, high = np.array(east["extent"]).T
    assert (low <= high).all()
    assert sum(np.diff(np.sign(low)) > 0) == 4
    answers = {"gravity": "9,81", "east_m unit": "s"}
    actual_columns, _ = draft_columns(page, uploaded, answers=answers)
    (problem,) = actual_columns["problems"]
    assert problem.startswith("east_m unit: 's' is not a unit of")


def test_unused_column_has_reason(page, folder):
    head, *rows = (folder / "three" / "slow.csv").read_text().splitlines()
    added = (f"{i},7,,ok,{(i * 7919) % 101},{row}" for i, row in enumerate(rows))
    text = "\n".join([f"index,status,marker,note,count,{head}", *added])
    name = upload(page, "odd/slow.csv", text.encode()).json()["name"]
    _, columns = draft_columns(page, [name], answers=COUNTED)
    reasons = {name: columns[name]["reason"] for name in ("index", "status", "marker", "note")}
    assert reasons == {
        "index": "The column contains row numbers.",
        "status": "The value is 7 in every row.",
        "marker": "The column has no values.",
        "note": "The column contains text, not numbers: ok",
    }
    assert columns["count"]["reason"].startswith("The column does not vary with the rotation")
    assert columns["note"]["curve"] is None


def test_site_values_are_suggested_from_measured_campaigns(page, folder, uploaded):
    columns, _ = draft_columns(page, uploaded)
    assert columns["remembered"] == {}  # that campaign is simulated
    answers = {
        question["key"]: question["example"]
        for question in columns["questions"]
        if question["guess"] is None
    }
    request = {"folder": "new", "names": uploaded, "answers": answers | ANSWERS}
    assert page.post("/api/drafted", json=request).status_code == 200
    columns, _ = draft_columns(page, uploaded)
    assert columns["remembered"] == {
        key: {"answer": answer, "campaign": "new"} for key, answer in ANSWERS.items()
    }
    # An invalid value is not suggested.
    file = folder / "new" / "campaign.toml"
    file.write_text(file.read_text().replace('"2.5 m"', '"2.5 kg"'))
    columns, _ = draft_columns(page, uploaded)
    assert set(columns["remembered"]) == {"gravity", "latitude"}


def test_unit_menu_offers_convertible_units(page, uploaded):
    columns, _ = draft_columns(page, uploaded)
    menus = {question["key"]: question["units"] for question in columns["questions"]}
    assert menus["radius"] == ["m", "mm", "um", "in"]
    for quantity, units in UNIT_CHOICES.items():
        assert all(is_convertible(unit, quantity) for unit in units)


def test_wrapped_angle_is_drawn_without_jumps():
    time = np.arange(400) * 0.05
    angle = FileColumn("angle", "deg", np.mod(36.0 * time, 360.0) + 0.01 * np.sin(time))
    east = FileColumn("east_m", "m", 2.5 * np.cos(np.deg2rad(36.0 * time)))
    seconds = FileColumn("time_s", "s", time)
    contents = FileContents(Path("a.csv"), (seconds, angle, east), (), "")
    curve = make_detrended_curve(angle, guess_file(contents))
    assert curve["size"] == pytest.approx(0.01, rel=0.2)
    warm = FileColumn("temp_degC", "", 20.0 + np.exp(-time))
    guess = guess_file(FileContents(Path("a.csv"), (seconds, angle, east, warm), (), ""))
    assert make_detrended_curve(warm, guess)["unit"] == "degC"


def test_text_columns_are_shown_where_required(page):
    table = "side,n_rpm,note,out_V\nin,30,first,1.0\nout,60,second,-4.0\n"
    name = upload(page, "arm/arm.csv", table.encode()).json()["name"]
    body = page.post("/api/draft", json={"names": [name]}).json()
    assert body["test"] == "arm"
    shown = {column["name"]: column["first"] for column in body["columns"]}
    assert shown["side"] == ["in", "out"]
    assert shown["note"] == ["first", "second"]
    assert [column["curve"] for column in body["columns"]][:2] == [None, None]


@pytest.mark.parametrize(
    ("name", "write", "note"),
    [
        ("a.h5", write_compound_file, "three-axis sensor: columns 'ax', 'ay', 'az'"),
        (
            "a.tdms",
            partial(write_waveform_file, ends=(0, 1, 2)),
            "channels truncated to the length of the shortest",
        ),
        ("b.tdms", partial(write_waveform_file, skipped=(0, 0, 200)), "channels aligned by start"),
    ],
)
def test_page_imports_tables_inside_containers(page, tmp_path, name, write, note):
    write(tmp_path / name)
    uploaded = upload(page, name, (tmp_path / name).read_bytes()).json()["name"]
    body = page.post("/api/draft", json={"names": [uploaded]}).json()
    assert body["test"] == "poses"
    assert note in " ".join(body["statements"])


@pytest.mark.parametrize("endpoint", ["draft", "drafted"])
def test_draft_without_files_is_refused(page, endpoint):
    more = {"folder": "new"} if endpoint == "drafted" else {}
    response = page.post(f"/api/{endpoint}", json={"names": [], **more})
    assert (response.status_code, response.json()["code"]) == (422, "request-refused")
