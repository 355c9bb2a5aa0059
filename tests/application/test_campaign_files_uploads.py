"""Uploads into the served folder."""

import os
import stat

from raising import raises

from counterspin.application.campaign_files import complete_upload, open_upload


def upload(page, name, content, **more):
    return page.post("/api/files", params={"name": name}, content=content, **more)


def test_invalid_upload_is_rejected(page, folder):
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
        assert upload(page, name, b"time_s\n1\n").status_code == status
    assert (folder / "three" / "slow.csv").read_bytes() == kept
    assert sorted(folder.rglob("*")) == before


def test_identical_file_can_be_uploaded_again(page, folder):
    content = (folder / "three" / "slow.csv").read_bytes()
    before = sorted(folder.rglob("*"))
    assert upload(page, "three/slow.csv", content).json() == {
        "name": "three/slow.csv",
        "bytes": len(content),
    }
    assert sorted(folder.rglob("*")) == before


def test_incomplete_upload_leaves_no_file(page, folder, monkeypatch):
    monkeypatch.setattr("counterspin.application.access_control.FILE_MAX_BYTES", 1000)
    assert upload(page, "new/a.csv", (b"x" * 100 for _ in range(20))).status_code == 413
    assert not (folder / "new").exists()


def test_compressed_file_is_rejected_before_upload(app):
    with raises("path-forbidden", "new/run.csv.gz:"):
        open_upload(app, "new/run.csv.gz")
    assert not app.folder.path("new").exists()


def test_aborted_upload_removes_folders_it_created(app, folder):
    first, second = open_upload(app, "far/away/a.csv"), open_upload(app, "far/b.csv")
    first.discard()
    assert [path.name for path in (folder / "far").iterdir()] == [second.temporary_path.parent.name]
    second.discard()
    assert (folder / "far").is_dir()  # the folder existed before the second upload
    third = open_upload(app, "three/a.csv")
    third.discard()
    assert (folder / "three").is_dir()


def test_second_upload_of_same_name_is_rejected(app, folder):
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


def test_uploaded_file_has_permissions_from_umask(app, folder):
    before = os.umask(0o077)
    try:
        arrival = open_upload(app, "new/a.csv")
        complete_upload(app, arrival)
        arrival.discard()
    finally:
        os.umask(before)
    assert stat.S_IMODE((folder / "new" / "a.csv").stat().st_mode) == 0o600
