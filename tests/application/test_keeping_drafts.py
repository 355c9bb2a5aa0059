"""Exports that are brought: guessed, asked, and a campaign of them."""

import os
import stat
from functools import partial

import numpy as np
import pytest
from exports import EXPORTS, campaign_folder, write_records
from posed_files import compound, waveforms
from served import ANSWERS

from counterspin.application.folder import OutsideError
from counterspin.application.keeping import complete_upload, place_for
from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.description import read_campaign
from counterspin.errors import CounterspinError
from counterspin.ingest.contents import read_files
from counterspin.ingest.description import draft, write_description

RUNS = ("slow", "middle", "fast")
COUNTED = {"sampling_rate": "20 Hz"}


def bring(page, name, content, **more):
    return page.post("/api/files", params={"name": name}, content=content, **more)


@pytest.fixture
def brought(page, folder):
    """Return the names of three records that were brought into a new folder."""
    contents = [(folder / "three" / f"{run}.csv").read_bytes() for run in RUNS]
    told = [bring(page, f"new/{run}.csv", c).json() for run, c in zip(RUNS, contents, strict=True)]
    assert [one["bytes"] for one in told] == list(map(len, contents))
    for run, content in zip(RUNS, contents, strict=True):
        assert (folder / "new" / f"{run}.csv").read_bytes() == content
    return [one["name"] for one in told]


def test_from_files_to_a_campaign(page, folder, brought):
    told = page.post("/api/draft", json={"names": brought}).json()
    assert any("time_s" in statement for statement in told["statements"])
    assert {"gravity", "latitude", "radius"} <= {one["key"] for one in told["questions"]}
    said = {"folder": "new", "names": brought}
    unanswered = page.post("/api/drafted", json=said)
    assert unanswered.status_code == 422
    assert any(problem.startswith("radius: ") for problem in unanswered.json()["problems"])
    needed = [one for one in told["questions"] if one["guess"] is None]
    answers = {one["key"]: one["example"] for one in needed} | ANSWERS
    made = page.post("/api/drafted", json=said | {"answers": answers}).json()
    assert made["command"].startswith("counterspin init ")
    campaign = read_campaign(folder / "new")
    rates = [run.rate for run in read_campaign(folder / "three").runs]
    assert [run.rate for run in campaign.runs] == pytest.approx(rates, rel=1e-3)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return campaign_folder(tmp_path_factory.mktemp("exports"))


def from_page(page, folder, files, sense="counterclockwise"):
    """Bring files, answer what is asked, and return K_II of the campaign that comes of it."""
    names = [bring(page, f"lab/{f.name}", f.read_bytes()).json()["name"] for f in files]
    asked = page.post("/api/draft", json={"names": names}).json()["questions"]
    known = ANSWERS | COUNTED | {"sense": sense}
    needed = [one for one in asked if one["guess"] is None]
    answers = {one["key"]: known.get(one["key"], one["example"]) for one in needed}
    said = {"folder": "lab", "names": names, "answers": answers}
    told = page.post("/api/drafted", json=said)
    assert told.status_code == 200, told.json()
    return calibrate(folder / "lab").accelerometers["Qx"].coefficients["K_II"]


@pytest.fixture(scope="module")
def reference(plain, tmp_path_factory):
    """Return what the plain records give with the same answers."""
    looks = read_files([plain / "slow.csv", plain / "fast.csv"])
    place = tmp_path_factory.mktemp("plain")
    write_description(draft(looks, ANSWERS | {"sense": "counterclockwise"}), place)
    return calibrate(place).accelerometers["Qx"].coefficients["K_II"]


@pytest.mark.parametrize("name", EXPORTS)
def test_every_make_of_export_gives_the_same_result(page, folder, plain, reference, name, tmp_path):
    files = write_records(plain, tmp_path / "files", EXPORTS[name])
    sense = "clockwise" if "clockwise" in name else "counterclockwise"
    found = from_page(page, folder, files, sense)
    assert abs(found.value - reference.value) < 0.01 * reference.u


def test_what_is_no_record_or_would_replace_one_is_not_taken(page, folder):
    kept = (folder / "three" / "slow.csv").read_bytes()
    before = sorted(folder.rglob("*"))
    for name, status in (
        ("three/slow.csv", 422),
        ("three/campaign.toml", 403),
        ("three/run.py", 403),
        ("../slow.csv", 403),
        (".hidden.csv", 403),
        ("", 403),
    ):
        assert bring(page, name, b"time_s\n1\n").status_code == status
    assert (folder / "three" / "slow.csv").read_bytes() == kept
    assert sorted(folder.rglob("*")) == before


def test_the_same_file_may_be_brought_again(page, folder):
    content = (folder / "three" / "slow.csv").read_bytes()
    before = sorted(folder.rglob("*"))
    assert bring(page, "three/slow.csv", content).json() == {
        "name": "three/slow.csv",
        "bytes": len(content),
    }
    assert sorted(folder.rglob("*")) == before


def test_a_draft_shows_columns_and_what_is_wrong(page, brought):
    told = page.post("/api/draft", json={"names": brought}).json()
    names = [column["name"] for column in told["columns"]]
    assert names[:2] == ["time_s", "angle_rad"]
    assert [len(column["first"]) for column in told["columns"]] == [4] * len(names)
    low, high = np.array(told["columns"][0]["extent"]).T
    assert (low[0], sorted(low)) == (0.0, low.tolist())
    assert (low < high).all()
    answers = {"gravity": "9,81", "east_m unit": "s"}
    told = page.post("/api/draft", json={"names": brought, "answers": answers}).json()
    (problem,) = told["problems"]
    assert problem.startswith("east_m unit: 's' is not a unit of")


def test_a_file_that_does_not_arrive_leaves_nothing(page, folder, monkeypatch):
    monkeypatch.setattr("counterspin.application.guard.FILE_BYTES", 1000)
    assert bring(page, "new/a.csv", (b"x" * 100 for _ in range(20))).status_code == 413
    assert not (folder / "new").exists()


def test_a_packed_file_is_refused_before_it_is_brought(desk):
    with pytest.raises(OutsideError, match=r"new/run\.csv\.gz: the file is packed; unpack it"):
        place_for(desk, "new/run.csv.gz")
    assert not desk.folder.path("new").exists()


def test_folders_that_were_made_for_it_go_too(desk, folder):
    first, second = place_for(desk, "far/away/a.csv"), place_for(desk, "far/b.csv")
    first.end()
    assert [path.name for path in (folder / "far").iterdir()] == [second.part.parent.name]
    second.end()
    assert (folder / "far").is_dir()  # it was there when the second one came
    third = place_for(desk, "three/a.csv")
    third.end()
    assert (folder / "three").is_dir()


def test_of_two_uploads_of_one_name_the_first_stays(desk, folder):
    first, second = place_for(desk, "new/a.csv"), place_for(desk, "new/a.csv")
    first.part.write_text("first")
    second.part.write_text("second")
    assert complete_upload(desk, first) == {"name": "new/a.csv", "bytes": 5}
    with pytest.raises(CounterspinError, match=r"a\.csv exists; name another file"):
        complete_upload(desk, second)
    first.end()
    second.end()
    assert [(path.name, path.read_text()) for path in (folder / "new").iterdir()] == [
        ("a.csv", "first")
    ]


def test_an_upload_has_the_rights_of_the_process(desk, folder):
    before = os.umask(0o077)
    try:
        arrival = place_for(desk, "new/a.csv")
        complete_upload(desk, arrival)
        arrival.end()
    finally:
        os.umask(before)
    assert stat.S_IMODE((folder / "new" / "a.csv").stat().st_mode) == 0o600


def test_columns_of_words_are_shown_where_they_are_asked_for(page):
    table = "side,n_rpm,note,out_V\nin,30,first,1.0\nout,30,second,-1.0\n"
    name = bring(page, "arm/arm.csv", table.encode()).json()["name"]
    told = page.post("/api/draft", json={"names": [name]}).json()
    assert told["test"] == "arm"
    shown = {column["name"]: column["first"] for column in told["columns"]}
    assert shown["side"] == ["in", "out"]
    assert shown["note"] == ["first", "second"]
    assert [column["extent"] for column in told["columns"]][:2] == [[], []]
    told = page.post("/api/draft", json={"names": [name], "test": "double-turntable"}).json()
    assert [column["name"] for column in told["columns"]] == ["n_rpm", "out_V"]


@pytest.mark.parametrize(
    ("name", "write", "note"),
    [
        ("a.h5", compound, "a sensor with three axes: columns 'ax', 'ay', 'az'"),
        ("a.tdms", partial(waveforms, ends=(0, 1, 2)), "channels cut to the shortest"),
        ("b.tdms", partial(waveforms, late=(0, 0, 200)), "channels aligned by their start"),
    ],
)
def test_the_page_imports_tables_within_files(page, tmp_path, name, write, note):
    write(tmp_path / name)
    brought = bring(page, name, (tmp_path / name).read_bytes()).json()["name"]
    told = page.post("/api/draft", json={"names": [brought]}).json()
    assert told["test"] == "poses"
    assert note in " ".join(told["statements"])
