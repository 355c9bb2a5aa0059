from dataclasses import replace

import campaigns
import frames
import numpy as np
import polars as pl
import pytest

from counterspin.campaign.description import make_campaign, read_campaign
from counterspin.errors import CampaignError, CounterspinError


def test_runs_of_all_with_names_of_their_own(tmp_path):
    one, two = (make_campaign(frames.untrue(), frames.arrays(tmp_path, seed)) for seed in (1, 2))
    joined = one.join(two)
    assert [run.name for run in joined.runs] == [
        *("slow", "middle", "fast"),
        *("slow (2)", "middle (2)", "fast (2)"),
    ]
    assert len({run.record for run in joined.runs}) == 6
    first, other = (joined.record_at(joined.runs[place].record) for place in (0, 3))
    assert str(other) == "slow (2) in memory"
    for table, campaign in ((first, one), (other, two)):
        columns = campaign.record_at(campaign.runs[0].record).columns
        np.testing.assert_array_equal(table.columns["east_m"], columns["east_m"])
    assert len(one.join(two, two.change(runs=["fast"])).runs) == 7


def test_files_stay_where_they_are(tmp_path):
    for name in ("a", "b"):
        campaigns.write(tmp_path / name, campaigns.SMALL)
    joined = read_campaign(tmp_path / "a").join(read_campaign(tmp_path / "b"))
    assert [run.record for run in joined.runs] == [
        tmp_path / folder / f"{name}.csv"
        for folder in ("a", "b")
        for name in ("slow", "middle", "fast")
    ]
    assert (joined.title, joined.simulation is None) == ("a + b", False)


def test_the_truth_is_kept_where_all_have_the_same(tmp_path):
    one = make_campaign(frames.small())
    same = make_campaign(frames.small(), folder=tmp_path)
    other = same.change(truth={"Qx": {"K_II": "5e-5 g/g^2"}})
    assert one.join(same).simulation is not None
    assert one.join(other).simulation is None


def test_a_record_counts_once():
    one = make_campaign(frames.small())
    with pytest.raises(CampaignError, match=r'"slow.csv" is already used by runs\[0\]'):
        one.join(one)


def test_what_is_assumed_and_held_is_the_same_in_all(tmp_path):
    model = {"assume": ["platform.*"], "hold": ["K_PP"], "priors": {"K_PP": "0 ± 1e-6 g/g^2"}}
    one, other = (
        make_campaign(frames.small(), folder=tmp_path / name).change(**model) for name in "ab"
    )
    joined = one.join(other)
    assert (joined.model.assume, joined.model.considered) == (("platform.*",), ("K_PP",))
    with pytest.raises(CampaignError) as wrong:
        one.join(other.change(assume="all", hold=None))
    assert wrong.value.problems == (
        "model.assume: is not the same in campaign 2",
        "model.hold: is not the same in campaign 2",
    )


def test_what_differs_is_told_with_what_both_say():
    one = make_campaign(frames.small())
    other = one.change(
        gravity="9.81 m/s^2",
        noise={"displacement": "0.02 m"},
        accelerometers={"Qx": {"scale_factor": "1.003 g/g"}},
        terms=["K_F"],
    ).change(accelerometers=["Qx"])
    with pytest.raises(CampaignError) as wrong:
        one.join(one, other)
    assert wrong.value.problems == (
        "site.gravity: is not the same in campaign 3 (9.8066 m/s^2, 9.81 m/s^2)",
        "noise: is not the same in campaign 3 ({'displacement': '0.01 m'}, "
        "{'displacement': '0.02 m'})",
        "accelerometers.Qx: is not the same in campaign 3 (priors)",
        "accelerometers.Qy: is not in campaign 3",
        "model.terms: is not the same in campaign 3",
    )


def test_the_same_number_written_otherwise_is_the_same(tmp_path):
    one, other = (make_campaign(frames.small(), folder=tmp_path / name) for name in "ab")
    assert len(one.join(other.change(radius="2500 mm")).runs) == 6


def test_a_campaign_without_its_description_is_not_joined():
    one = make_campaign(frames.small())
    with pytest.raises(CounterspinError, match="its description is unknown"):
        one.join(replace(one, title="other"))


def test_what_is_written_reads_back_to_the_last_bit(tmp_path):
    records = frames.arrays(tmp_path)
    document = frames.untrue()
    document["runs"][1]["record"] = "in/middle.csv"
    made = make_campaign(document, records)
    file = made.write(tmp_path / "written")
    back = read_campaign(tmp_path / "written")
    assert back.source.document == made.source.document
    assert back.source.content_checksum() == made.source.content_checksum()
    assert file == tmp_path / "written" / "campaign.toml"
    for run, read in zip(made.runs, (pl.read_parquet, pl.read_csv, pl.read_parquet), strict=True):
        columns = read(tmp_path / "written" / run.record.relative_to(made.folder))
        for name, values in made.record_at(run.record).columns.items():
            np.testing.assert_array_equal(columns[name].to_numpy(), values)


@pytest.fixture
def recorded(tmp_path):
    campaigns.write(tmp_path / "a", "# mine\n" + campaigns.SMALL)
    for name, columns in frames.arrays(tmp_path).items():
        pl.DataFrame(dict(columns)).write_csv(tmp_path / "a" / f"{name}.csv")
    return tmp_path / "a"


def test_all_files_of_a_run_are_copied_and_joined(recorded, tmp_path):
    """Those in which its record goes on, that of its pulses, and a record of two runs."""
    angle = 'angle = { column = "angle_rad", unit = "rad" }'
    more = 'continued_in = ["slow-2.csv"]\npulses = "index.csv"\nstop = "9 s"'
    again = '[[runs]]\nname = "end"\nrate = "0.25 rev/s"\nrecord = "slow.csv"\nstart = "9 s"\n'
    text = campaigns.changed(
        campaigns.SMALL,
        (angle, 'angle = { column = "i", unit = "s", pulses = true }'),
        ('name = "slow"', f'name = "slow"\n{more}'),
        ("[simulation]", f"{again}\n[simulation]"),
    )
    (recorded / "campaign.toml").write_text(text)
    for name in ("slow-2.csv", "index.csv"):
        (recorded / name).write_text(name)
    campaign = read_campaign(recorded)
    campaign.write(tmp_path / "b")
    names = {path.name for path in (tmp_path / "b").iterdir()}
    assert names == {path.name for path in recorded.iterdir()}
    other = read_campaign(tmp_path / "b")
    joined = campaign.join(other)
    assert joined.runs[4].files == other.runs[0].files


def test_files_named_from_the_root_are_copied_to_where_they_were(recorded, tmp_path):
    (recorded / "in").mkdir()
    slow = (recorded / "slow.csv").rename(recorded / "in" / "slow.csv")
    there = f"record = '{slow}'"
    text = campaigns.changed(campaigns.SMALL, ('record = "slow.csv"', there))
    (recorded / "campaign.toml").write_text(text)
    read_campaign(recorded).write(tmp_path / "b")
    assert read_campaign(tmp_path / "b").runs[0].record == tmp_path / "b" / "in" / "slow.csv"
    assert (tmp_path / "b" / "in" / "slow.csv").read_bytes() == slow.read_bytes()


def test_a_folder_is_copied_as_it_is(recorded, tmp_path):
    campaign = read_campaign(recorded)
    campaign.write(tmp_path / "b")
    for name in ("campaign.toml", "slow.csv", "middle.csv", "fast.csv"):
        assert (tmp_path / "b" / name).read_bytes() == (recorded / name).read_bytes()
    # Into its own place there is nothing to do.
    campaign.write(recorded, overwrite=True)
    assert (recorded / "campaign.toml").read_text().startswith("# mine")


def test_records_from_elsewhere_come_along_under_names_of_their_own(recorded, tmp_path):
    document = frames.small()
    for run, place in zip(
        document["runs"], ("a/slow.csv", "c/slow.csv", "c/Slow.csv"), strict=True
    ):
        run["record"] = str(tmp_path / place)
    (tmp_path / "c").mkdir()
    for name in ("slow", "Slow"):
        (tmp_path / "c" / f"{name}.csv").write_bytes((recorded / "fast.csv").read_bytes())
    make_campaign(document, folder=tmp_path / "other").write(tmp_path / "b")
    back = read_campaign(tmp_path / "b")
    names = [run.record.name for run in back.runs]
    assert len({name.lower() for name in names}) == 3
    assert back.runs[0].record.read_bytes() == (recorded / "slow.csv").read_bytes()
    assert back.runs[1].record.read_bytes() == (recorded / "fast.csv").read_bytes()


def test_nothing_is_overwritten_and_nothing_left_behind(recorded, tmp_path):
    campaign = read_campaign(recorded)
    with pytest.raises(CounterspinError, match=r"campaign\.toml exists; write into another folder"):
        campaign.write(recorded)
    (recorded / "fast.csv").unlink()
    with pytest.raises(CounterspinError, match=r"fast\.csv: there is no such record to copy"):
        campaign.write(tmp_path / "b")
    assert not (tmp_path / "b").exists()
