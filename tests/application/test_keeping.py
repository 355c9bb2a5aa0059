"""Campaigns as folders: copied, renamed, put away."""

import pytest

from counterspin.application.keeping import TRASH, copy_campaign, put_away, rename_campaign
from counterspin.errors import CounterspinError


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_copy_has_all_that_the_campaign_has(desk, folder):
    before = names(folder / "three")
    (folder / "three" / ".hidden").write_text("x")
    assert copy_campaign(desk, "three", "lab/second") == {"name": "lab/second"}
    assert names(folder / "lab" / "second") == before
    assert desk.campaign("lab/second").runs
    assert names(folder / "lab") == ["second"]  # no part of it is left beside it


def test_another_name_is_another_folder(desk, folder):
    before = names(folder / "three")
    assert rename_campaign(desk, "three", "third") == {"name": "third"}
    assert names(folder) == ["third"]
    assert names(folder / "third") == before


def test_what_is_put_away_is_kept(desk, folder, page):
    before = names(folder / "three")
    place = put_away(desk, "three")["place"]
    assert place.startswith(f"{TRASH}/")
    assert names(folder / place) == before
    assert page.get("/api/folder").json()["campaigns"] == []


@pytest.mark.parametrize("how", [copy_campaign, rename_campaign])
@pytest.mark.parametrize(
    ("to", "told"),
    [
        ("three", "three exists, and is not replaced"),
        ("", "this folder exists"),
        ("three/inside", "lies in three"),
        ("../out", "is not a valid file name in this folder"),
        (".hidden", "is not a valid file name in this folder"),
    ],
)
def test_nothing_is_replaced_and_nothing_leaves(desk, folder, how, to, told):
    before = sorted(folder.rglob("*"))
    with pytest.raises(CounterspinError, match=told):
        how(desk, "three", to)
    assert sorted(folder.rglob("*")) == before


def test_links_are_left_alone(desk, folder, tmp_path_factory):
    (folder / "three" / "more").symlink_to(tmp_path_factory.mktemp("outside"))
    for act in (lambda: copy_campaign(desk, "three", "four"), lambda: put_away(desk, "three")):
        with pytest.raises(CounterspinError, match="three/more is a link"):
            act()
    (folder / "three" / "more").unlink()
    (folder / "linked").symlink_to(folder / "three")
    with pytest.raises(CounterspinError, match="linked is a link to a folder"):
        put_away(desk, "linked")
    assert (folder / "three" / "campaign.toml").is_file()


def test_a_campaign_that_names_files_beside_its_folder_stays_beside_them(desk, folder):
    (folder / "three" / "slow.csv").rename(folder / "slow.csv")
    file = folder / "three" / "campaign.toml"
    file.write_text(file.read_text().replace('"slow.csv"', '"../slow.csv"'))
    with pytest.raises(CounterspinError, match="names files outside of its folder"):
        rename_campaign(desk, "three", "lab/three")
    rename_campaign(desk, "three", "third")
    assert desk.campaign("third").runs


def test_nothing_moves_while_a_job_is_at_work(desk, folder, page):
    with desk.jobs._turn:
        assert page.post("/api/jobs", json={"name": "three"}).status_code == 200
        for name, said in (("rename", {"to": "third"}), ("put-away", {})):
            told = page.post(f"/api/{name}", json={"name": "three"} | said)
            assert told.status_code == 422
            assert "a job is running in it" in told.json()["error"]
        desk.jobs.stop(desk.jobs.all()[-1].number)
    assert (folder / "three").is_dir()


def test_the_folder_that_is_served_stays(desk, folder):
    text = (folder / "three" / "campaign.toml").read_text()
    (folder / "campaign.toml").write_text(text)
    with pytest.raises(CounterspinError, match="is the served folder itself"):
        put_away(desk, "")
