import campaigns
import frames
import numpy as np
import polars as pl
import pytest
from raising import raises

from counterspin.campaign.description import read_campaign
from counterspin.campaign.memory import make_campaign
from counterspin.errors import CounterspinError


def test_written_campaign_round_trips_exactly(tmp_path):
    records = frames.simulate_columns(tmp_path)
    document = frames.parse_description_without_truth()
    document["runs"][1]["record"] = "in/middle.csv"
    campaign = make_campaign(document, records)
    file = campaign.write(tmp_path / "written")
    back = read_campaign(tmp_path / "written")
    assert back.source.document == campaign.source.document
    assert back.source.content_checksum() == campaign.source.content_checksum()
    assert file == tmp_path / "written" / "campaign.toml"
    for run, read in zip(
        campaign.runs, (pl.read_parquet, pl.read_csv, pl.read_parquet), strict=True
    ):
        columns = read(tmp_path / "written" / run.record.relative_to(campaign.folder))
        for name, values in campaign.record_at(run.record).columns.items():
            np.testing.assert_array_equal(columns[name].to_numpy(), values)


@pytest.fixture
def recorded_folder(tmp_path):
    campaigns.write_description(tmp_path / "a", "# mine\n" + campaigns.SMALL)
    for name, columns in frames.simulate_columns(tmp_path).items():
        pl.DataFrame(dict(columns)).write_csv(tmp_path / "a" / f"{name}.csv")
    return tmp_path / "a"


def test_all_files_of_run_are_copied(recorded_folder, tmp_path):
    """Continuation files, the file of the pulses and a record of two runs."""
    angle = 'angle = { column = "angle_rad", unit = "rad" }'
    more = 'continued_in = ["slow-2.csv"]\npulses = "index.csv"\nstop = "9 s"'
    repeated_run = (
        '[[runs]]\nname = "end"\nrate = "0.25 rev/s"\nrecord = "slow.csv"\nstart = "9 s"\n'
    )
    text = campaigns.replace_parts(
        campaigns.SMALL,
        (angle, 'angle = { column = "i", unit = "s", pulses = true }'),
        ('name = "slow"', f'name = "slow"\n{more}'),
        ("[simulation]", f"{repeated_run}\n[simulation]"),
    )
    (recorded_folder / "campaign.toml").write_text(text)
    for name in ("slow-2.csv", "index.csv"):
        (recorded_folder / name).write_text(name)
    campaign = read_campaign(recorded_folder)
    campaign.write(tmp_path / "b")
    names = {path.name for path in (tmp_path / "b").iterdir()}
    assert names == {path.name for path in recorded_folder.iterdir()}


def test_absolute_paths_are_copied_to_relative_location(recorded_folder, tmp_path):
    (recorded_folder / "in").mkdir()
    slow = (recorded_folder / "slow.csv").rename(recorded_folder / "in" / "slow.csv")
    there = f"record = '{slow}'"
    text = campaigns.replace_parts(campaigns.SMALL, ('record = "slow.csv"', there))
    (recorded_folder / "campaign.toml").write_text(text)
    read_campaign(recorded_folder).write(tmp_path / "b")
    assert read_campaign(tmp_path / "b").runs[0].record == tmp_path / "b" / "in" / "slow.csv"
    assert (tmp_path / "b" / "in" / "slow.csv").read_bytes() == slow.read_bytes()


def test_folder_is_copied_unchanged(recorded_folder, tmp_path):
    campaign = read_campaign(recorded_folder)
    campaign.write(tmp_path / "b")
    for name in ("campaign.toml", "slow.csv", "middle.csv", "fast.csv"):
        assert (tmp_path / "b" / name).read_bytes() == (recorded_folder / name).read_bytes()
    # Writing to the same folder changes nothing.
    campaign.write(recorded_folder, overwrite=True)
    assert (recorded_folder / "campaign.toml").read_text().startswith("# mine")


def test_external_records_are_copied_under_unique_names(recorded_folder, tmp_path):
    document = frames.parse_small_description()
    for run, place in zip(
        document["runs"], ("a/slow.csv", "c/slow.csv", "c/Slow.csv"), strict=True
    ):
        run["record"] = str(tmp_path / place)
    (tmp_path / "c").mkdir()
    for name in ("slow", "Slow"):
        (tmp_path / "c" / f"{name}.csv").write_bytes((recorded_folder / "fast.csv").read_bytes())
    make_campaign(document, folder=tmp_path / "other").write(tmp_path / "b")
    back = read_campaign(tmp_path / "b")
    names = [run.record.name for run in back.runs]
    assert len({name.lower() for name in names}) == 3
    assert back.runs[0].record.read_bytes() == (recorded_folder / "slow.csv").read_bytes()
    assert back.runs[1].record.read_bytes() == (recorded_folder / "fast.csv").read_bytes()


def test_write_does_not_overwrite_or_leave_partial_folder(recorded_folder, tmp_path):
    campaign = read_campaign(recorded_folder)
    with raises("file-exists", "campaign.toml"):
        campaign.write(recorded_folder)
    (recorded_folder / "fast.csv").unlink()
    with pytest.raises(CounterspinError, match=r"fast\.csv: file not found"):
        campaign.write(tmp_path / "b")
    assert not (tmp_path / "b").exists()
