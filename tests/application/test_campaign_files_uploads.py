"""Files that are uploaded into the served folder."""

import os
import stat

from raising import raises

from counterspin.application.campaign_files import complete_upload, open_upload


def bring(page, name, content, **more):
    return page.post("/api/files", params={"name": name}, content=content, **more)


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


def test_a_file_that_does_not_arrive_leaves_nothing(page, folder, monkeypatch):
    monkeypatch.setattr("counterspin.application.access_control.FILE_MAX_BYTES", 1000)
    assert bring(page, "new/a.csv", (b"x" * 100 for _ in range(20))).status_code == 413
    assert not (folder / "new").exists()


def test_a_packed_file_is_refused_before_it_is_brought(app):
    with raises("path-forbidden", "new/run.csv.gz:"):
        open_upload(app, "new/run.csv.gz")
    assert not app.folder.path("new").exists()


def test_folders_that_were_made_for_it_go_too(app, folder):
    first, second = open_upload(app, "far/away/a.csv"), open_upload(app, "far/b.csv")
    first.discard()
    assert [path.name for path in (folder / "far").iterdir()] == [second.temporary_path.parent.name]
    second.discard()
    assert (folder / "far").is_dir()  # it was there when the second one came
    third = open_upload(app, "three/a.csv")
    third.discard()
    assert (folder / "three").is_dir()


def test_of_two_uploads_of_one_name_the_first_stays(app, folder):
    first, second = open_upload(app, "new/a.csv"), open_upload(app, "new/a.csv")
    first.temporary_path.write_text("first")
    second.temporary_path.write_text("second")
    assert complete_upload(app, first) == {"name": "new/a.csv", "bytes": 5}
    with raises("file-exists", "a.csv"):
        complete_upload(app, second)
    first.discard()
    second.discard()
    assert [(path.name, path.read_text()) for path in (folder / "new").iterdir()] == [
        ("a.csv", "first")
    ]


def test_an_upload_has_the_rights_of_the_process(app, folder):
    before = os.umask(0o077)
    try:
        arrival = open_upload(app, "new/a.csv")
        complete_upload(app, arrival)
        arrival.discard()
    finally:
        os.umask(before)
    assert stat.S_IMODE((folder / "new" / "a.csv").stat().st_mode) == 0o600
