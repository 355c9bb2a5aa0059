"""Campaigns as folders: copied, renamed, put away, given records."""

import numpy as np
import polars as pl
import pytest
from raising import raises

from counterspin.application.campaign_files import (
    TRASH,
    add_records,
    copy_campaign,
    discard_uploads,
    move_to_trash,
    rename_campaign,
    restore_campaign,
    trash_contents,
)
from counterspin.campaign.description import read_campaign
from counterspin.errors import CounterspinError
from counterspin.ingest.starter import init


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_copy_has_all_that_the_campaign_has(app, folder):
    before = names(folder / "three")
    (folder / "three" / ".hidden").write_text("x")
    assert copy_campaign(app, "three", "lab/second") == {"name": "lab/second"}
    assert names(folder / "lab" / "second") == before
    assert app.campaign("lab/second").runs
    assert names(folder / "lab") == ["second"]  # no part of it is left beside it


def test_another_name_is_another_folder(app, folder):
    before = names(folder / "three")
    assert rename_campaign(app, "three", "third") == {"name": "third"}
    assert names(folder) == ["third"]
    assert names(folder / "third") == before


def test_what_is_put_away_is_kept(app, folder, page):
    before = names(folder / "three")
    place = move_to_trash(app, "three")["place"]
    assert names(folder / TRASH / place) == before
    told = page.get("/api/folder").json()
    assert told["campaigns"] == []
    assert told["trash"] == [{"place": place, "name": "three"}]


def test_what_is_restored_replaces_nothing(app, folder):
    before = names(folder / "three")
    copy_campaign(app, "three", "lab/first")
    for name, restored in (("lab/first", "lab/first"), ("three", "three-2")):
        place = move_to_trash(app, name)["place"]
        if name == "three":
            copy_campaign(app, "lab/first", "three")
        assert restore_campaign(app, place) == {"name": restored, "files": []}
        assert names(folder / restored) == before
    assert trash_contents(app) == []


def test_discarded_files_are_in_the_trash_until_they_are_restored(app, folder):
    (folder / "new").mkdir()
    for name in ("a.csv", "b.csv", "notes.txt"):
        (folder / "new" / name).write_text(name)
    discarded = ["new/a.csv", "new/b.csv", "new/missing.csv"]
    place = discard_uploads(app, "new", discarded)["place"]
    assert names(folder / "new") == ["notes.txt"]
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
def test_only_files_of_an_import_are_discarded(app, folder, source, name, words):
    before = sorted(folder.rglob("*"))
    with pytest.raises(CounterspinError, match=words):
        discard_uploads(app, source, [name])
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize("place", ["", "three", "../three", "20260101T000000000000-..%2F..%2Fout"])
def test_only_what_is_in_the_trash_is_restored(app, folder, place):
    (folder / TRASH).mkdir()
    before = sorted(folder.rglob("*"))
    with pytest.raises(CounterspinError):
        restore_campaign(app, place)
    assert sorted(folder.rglob("*")) == before


def test_a_trash_that_is_a_link_to_another_folder_is_empty(app, folder, tmp_path_factory):
    outside = tmp_path_factory.mktemp("outside")
    (outside / "20260101T000000000000-theirs").mkdir()
    (folder / TRASH).symlink_to(outside)
    assert trash_contents(app) == []
    with pytest.raises(CounterspinError, match="is not in the trash"):
        restore_campaign(app, "20260101T000000000000-theirs")
    assert names(outside) == ["20260101T000000000000-theirs"]


def test_a_planted_name_does_not_lead_out_of_the_folder(app, folder):
    planted = "20260101T000000000000-..%2F..%2Fout"
    (folder / TRASH / planted).mkdir(parents=True)
    with pytest.raises(CounterspinError, match="not a valid file name"):
        restore_campaign(app, planted)


@pytest.mark.parametrize("how", [copy_campaign, rename_campaign])
@pytest.mark.parametrize(
    ("to", "told"),
    [
        ("three", "three already exists; choose another name"),
        ("", "this folder already exists"),
        ("three/inside", "is inside three"),
        ("../out", "is not a valid file name in this folder"),
        (".hidden", "is not a valid file name in this folder"),
    ],
)
def test_nothing_is_replaced_and_nothing_leaves(app, folder, how, to, told):
    before = sorted(folder.rglob("*"))
    with pytest.raises(CounterspinError, match=told):
        how(app, "three", to)
    assert sorted(folder.rglob("*")) == before


def test_links_are_left_alone(app, folder, tmp_path_factory):
    (folder / "three" / "more").symlink_to(tmp_path_factory.mktemp("outside"))
    for act in (lambda: copy_campaign(app, "three", "four"), lambda: move_to_trash(app, "three")):
        with pytest.raises(CounterspinError, match="three/more is a link"):
            act()
    (folder / "three" / "more").unlink()
    (folder / "linked").symlink_to(folder / "three")
    with raises("path-forbidden", "linked"):
        move_to_trash(app, "linked")
    assert (folder / "three" / "campaign.toml").is_file()


def test_a_campaign_that_names_files_beside_its_folder_stays_beside_them(app, folder):
    (folder / "three" / "slow.csv").rename(folder / "slow.csv")
    file = folder / "three" / "campaign.toml"
    file.write_text(file.read_text().replace('"slow.csv"', '"../slow.csv"'))
    with raises("request-refused"):
        rename_campaign(app, "three", "lab/three")
    rename_campaign(app, "three", "third")
    assert app.campaign("third").runs


def test_nothing_moves_while_a_job_is_at_work(app, folder, page):
    with app.jobs._run_lock:
        assert page.post("/api/jobs", json={"name": "three"}).status_code == 200
        for name, said in (("rename", {"to": "third"}), ("put-away", {})):
            told = page.post(f"/api/{name}", json={"name": "three"} | said)
            assert told.status_code == 422
            assert told.json()["code"] == "request-refused"
        app.jobs.stop(app.jobs.all()[-1].number)
    assert (folder / "three").is_dir()


def test_the_folder_that_is_served_stays(app, folder):
    text = (folder / "three" / "campaign.toml").read_text()
    (folder / "campaign.toml").write_text(text)
    with pytest.raises(CounterspinError, match="is the served folder itself"):
        move_to_trash(app, "")


def further(folder, name, rate, **columns):
    """Write a record of 40 s at a rate, rad/s, as those of the campaign are."""
    time = np.arange(800) * 0.05
    wave = {"east_m": 2.5 * np.cos(rate * time), "north_m": 2.5 * np.sin(rate * time)}
    data = {"time_s": time, "angle_rad": rate * time, **wave, **columns}
    pl.DataFrame(data).write_csv(folder / "three" / name)
    return f"three/{name}"


def test_a_record_becomes_a_run_at_the_rate_that_it_shows(app, folder):
    files = [further(folder, "a.csv", 1.5 * np.pi), further(folder, "b c.csv", -0.6 * np.pi)]
    told = add_records(app, "three", files)
    assert told == {"added": ["a at 0.75 rev/s", "b_c at -0.3 rev/s"]}
    *_, first, second = read_campaign(folder / "three").runs
    assert [first.rate, second.rate] == pytest.approx([1.5 * np.pi, -0.6 * np.pi], rel=1e-12)
    assert second.record == folder / "three" / "b c.csv"
    assert add_records(app, "three", files) == {"added": []}  # they are runs now


def test_a_record_without_a_wave_is_no_run(app, folder):
    still = dict.fromkeys(("angle_rad", "east_m", "north_m"), np.zeros(800))
    before = (folder / "three" / "campaign.toml").read_bytes()
    with raises("missing-answer", "a.csv:"):
        add_records(app, "three", [further(folder, "a.csv", 1.0, **still)])
    assert (folder / "three" / "campaign.toml").read_bytes() == before


def test_readings_are_no_records(app, folder):
    init(folder / "tumble", "tumble")
    with pytest.raises(CounterspinError, match="uses readings, not records"):
        add_records(app, "tumble", ["three/slow.csv"])
