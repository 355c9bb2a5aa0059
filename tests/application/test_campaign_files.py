"""Copying, renaming and deleting campaigns, and adding records to them."""

import numpy as np
import polars as pl
import pytest
from raising import raises

from counterspin.application.campaign_files import (
    TRASH_FOLDER,
    add_records,
    copy_campaign,
    discard_uploads,
    list_trash,
    move_to_trash,
    rename_campaign,
    restore_campaign,
)
from counterspin.campaign.description import read_campaign
from counterspin.errors import CounterspinError
from counterspin.ingest.starter import init


def file_names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_copy_has_all_files_of_campaign(app, folder):
    before = file_names(folder / "three")
    (folder / "three" / ".hidden").write_text("x")
    assert copy_campaign(app, "three", "lab/second") == {"name": "lab/second"}
    assert file_names(folder / "lab" / "second") == before
    assert app.campaign("lab/second").runs
    assert file_names(folder / "lab") == ["second"]  # no partial copy remains


def test_rename_moves_campaign_folder(app, folder):
    before = file_names(folder / "three")
    assert rename_campaign(app, "three", "third") == {"name": "third"}
    assert file_names(folder) == ["third"]
    assert file_names(folder / "third") == before


def test_deleted_campaign_is_in_trash(app, folder, page):
    before = file_names(folder / "three")
    place = move_to_trash(app, "three")["place"]
    assert file_names(folder / TRASH_FOLDER / place) == before
    body = page.get("/api/folder").json()
    assert body["campaigns"] == []
    assert body["trash"] == [{"place": place, "name": "three"}]


@pytest.mark.parametrize("name", ["加速度計の校正" * 10, "акселерометр-" * 8, "100 % of a/b%2Fc"])
def test_campaign_with_long_or_special_name_can_be_restored_from_trash(app, name):
    copy_campaign(app, "three", name)
    place = move_to_trash(app, name)["place"]
    assert list_trash(app) == [{"place": place, "name": name}]
    assert restore_campaign(app, place)["name"] == name


def test_restore_does_not_overwrite_campaign(app, folder):
    before = file_names(folder / "three")
    copy_campaign(app, "three", "lab/first")
    for name, restored in (("lab/first", "lab/first"), ("three", "three-2")):
        place = move_to_trash(app, name)["place"]
        if name == "three":
            copy_campaign(app, "lab/first", "three")
        assert restore_campaign(app, place) == {"name": restored, "files": []}
        assert file_names(folder / restored) == before
    assert list_trash(app) == []


def test_discarded_uploads_can_be_restored(app, folder):
    (folder / "new").mkdir()
    for name in ("a.csv", "b.csv", "notes.txt"):
        (folder / "new" / name).write_text(name)
    discarded = ["new/a.csv", "new/b.csv", "new/missing.csv"]
    place = discard_uploads(app, "new", discarded)["place"]
    assert file_names(folder / "new") == ["notes.txt"]
    assert discard_uploads(app, "new", discarded) == {"place": None}
    restored = {"name": "new-2", "files": ["new-2/a.csv", "new-2/b.csv"]}
    assert restore_campaign(app, place) == restored
    assert (folder / "new-2" / "a.csv").read_text() == "a.csv"
    discard_uploads(app, "new", ["new/notes.txt"])
    assert not (folder / "new").exists()


@pytest.mark.parametrize(
    ("source", "name", "words"),
    [
        ("three", "three/slow.csv", "three is a campaign, so its files were not discarded"),
        ("new", "three/slow.csv", "only files in the import folder"),
        ("", "slow.csv", "only files in the import folder"),
        ("new", "../slow.csv", "not a valid file name"),
    ],
)
def test_discard_rejects_files_that_were_not_uploaded(app, folder, source, name, words):
    before = sorted(folder.rglob("*"))
    with pytest.raises(CounterspinError, match=words):
        discard_uploads(app, source, [name])
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize("place", ["", "three", "../three", "20260101T000000000000-..%2F..%2Fout"])
def test_restore_rejects_name_not_in_trash(app, folder, place):
    (folder / TRASH_FOLDER).mkdir()
    before = sorted(folder.rglob("*"))
    with pytest.raises(CounterspinError):
        restore_campaign(app, place)
    assert sorted(folder.rglob("*")) == before


def test_symlinked_trash_is_treated_as_empty(app, folder, tmp_path_factory):
    outside = tmp_path_factory.mktemp("outside")
    (outside / "20260101T000000000000-theirs").mkdir()
    (folder / TRASH_FOLDER).symlink_to(outside)
    assert list_trash(app) == []
    with pytest.raises(CounterspinError, match="is not in the trash"):
        restore_campaign(app, "20260101T000000000000-theirs")
    assert file_names(outside) == ["20260101T000000000000-theirs"]


def test_trash_entry_with_path_in_name_is_rejected(app, folder):
    planted = "20260101T000000000000-..%2F..%2Fout"
    (folder / TRASH_FOLDER / planted).mkdir(parents=True)
    with pytest.raises(CounterspinError, match="not a valid file name"):
        restore_campaign(app, planted)


@pytest.mark.parametrize("how", [copy_campaign, rename_campaign])
@pytest.mark.parametrize(
    ("to", "message"),
    [
        ("three", "three already exists; choose another name"),
        ("", "this folder already exists"),
        ("three/inside", "is inside three"),
        ("../out", "is not a valid file name in this folder"),
        (".hidden", "is not a valid file name in this folder"),
        ("x" * 300, "is too long"),
    ],
)
def test_copy_and_rename_reject_invalid_destination(app, folder, how, to, message):
    before = sorted(folder.rglob("*"))
    with pytest.raises(CounterspinError, match=message):
        how(app, "three", to)
    assert sorted(folder.rglob("*")) == before


def test_copy_and_delete_reject_symlinks(app, folder, tmp_path_factory):
    (folder / "three" / "more").symlink_to(tmp_path_factory.mktemp("outside"))
    for act in (lambda: copy_campaign(app, "three", "four"), lambda: move_to_trash(app, "three")):
        with pytest.raises(CounterspinError, match="three/more is a link"):
            act()
    (folder / "three" / "more").unlink()
    (folder / "linked").symlink_to(folder / "three")
    with raises("path-forbidden", "linked"):
        move_to_trash(app, "linked")
    assert (folder / "three" / "campaign.toml").is_file()


def test_rename_rejects_move_that_breaks_relative_paths(app, folder):
    (folder / "three" / "slow.csv").rename(folder / "slow.csv")
    file = folder / "three" / "campaign.toml"
    file.write_text(file.read_text().replace('"slow.csv"', '"../slow.csv"'))
    with raises("request-refused"):
        rename_campaign(app, "three", "lab/three")
    rename_campaign(app, "three", "third")
    assert app.campaign("third").runs


def test_rename_is_rejected_while_job_runs(app, folder, page):
    with app.jobs._run_lock:
        assert page.post("/api/jobs", json={"name": "three"}).status_code == 200
        for name, body in (("rename", {"to": "third"}), ("put-away", {})):
            response = page.post(f"/api/{name}", json={"name": "three"} | body)
            assert response.status_code == 422
            assert response.json()["code"] == "request-refused"
        app.jobs.stop(app.jobs.all()[-1].number)
    assert (folder / "three").is_dir()


def test_served_folder_cannot_be_moved(app, folder):
    text = (folder / "three" / "campaign.toml").read_text()
    (folder / "campaign.toml").write_text(text)
    with pytest.raises(CounterspinError, match="is the served folder itself"):
        move_to_trash(app, "")


def add_record(folder, name, rate, **columns):
    """Write a record of 40 s at a rate, rad/s, in the format of the campaign."""
    time = np.arange(800) * 0.05
    wave = {"east_m": 2.5 * np.cos(rate * time), "north_m": 2.5 * np.sin(rate * time)}
    data = {"time_s": time, "angle_rad": rate * time, **wave, **columns}
    pl.DataFrame(data).write_csv(folder / "three" / name)
    return f"three/{name}"


def test_added_record_becomes_run_at_measured_rate(app, folder):
    files = [add_record(folder, "a.csv", 1.5 * np.pi), add_record(folder, "b c.csv", -0.6 * np.pi)]
    records = add_records(app, "three", files)
    assert records == {"added": ["a at 0.75 rev/s", "b_c at -0.3 rev/s"]}
    *_, first, second = read_campaign(folder / "three").runs
    assert [first.rate, second.rate] == pytest.approx([1.5 * np.pi, -0.6 * np.pi], rel=1e-12)
    assert second.record == folder / "three" / "b c.csv"
    assert add_records(app, "three", files) == {"added": []}  # they are runs now


def test_record_without_harmonic_is_rejected(app, folder):
    still = dict.fromkeys(("angle_rad", "east_m", "north_m"), np.zeros(800))
    before = (folder / "three" / "campaign.toml").read_bytes()
    with raises("missing-answer", "a.csv:"):
        add_records(app, "three", [add_record(folder, "a.csv", 1.0, **still)])
    assert (folder / "three" / "campaign.toml").read_bytes() == before


def test_add_records_rejects_campaign_of_readings(app, folder):
    init(folder / "tumble", "tumble")
    with pytest.raises(CounterspinError, match="uses readings, not records"):
        add_records(app, "tumble", ["three/slow.csv"])
