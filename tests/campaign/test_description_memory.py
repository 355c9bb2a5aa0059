import campaigns
import frames
import polars as pl
import pytest
from raising import raises

from counterspin.campaign.description import read_campaign
from counterspin.campaign.memory import make_campaign
from counterspin.campaign.quantity import Quantity
from counterspin.errors import CampaignError


def test_mapping_is_equivalent_to_file(tmp_path):
    file = campaigns.write_description(tmp_path, campaigns.SMALL)
    of_file, campaign = (
        read_campaign(file),
        make_campaign(frames.parse_small_description(), folder=tmp_path),
    )
    apart = {"path", "title", "runs", "source", "frames", "simulation"}
    for name in set(vars(of_file)) - apart:
        assert getattr(campaign, name) == getattr(of_file, name), name
    assert [run.record for run in campaign.runs] == [run.record for run in of_file.runs]
    assert (campaign.title, str(campaign.path)) == ("", "campaign in memory")


def test_frames_replace_files(tmp_path):
    records = frames.simulate_columns(tmp_path)
    campaign = make_campaign(frames.parse_description_without_truth(), records, folder=tmp_path)
    assert [run.record.name for run in campaign.runs] == [
        "slow.parquet",
        "middle.parquet",
        "fast.parquet",
    ]
    table = campaign.record_at(campaign.runs[0].record)
    assert str(table) == "slow in memory"
    assert (table.columns["time_s"] == records["slow"]["time_s"]).all()


def test_record_may_be_path_or_frame(tmp_path):
    records = dict(frames.simulate_columns(tmp_path))
    pl.DataFrame(dict(records["slow"])).write_csv(tmp_path / "elsewhere.csv")
    records["slow"] = tmp_path / "elsewhere.csv"
    document = frames.parse_description_without_truth()
    document["runs"][1]["record"] = "stated.csv"
    campaign = make_campaign(document, records, folder=tmp_path)
    slow, middle, _ = campaign.runs
    assert campaign.record_at(slow.record) == tmp_path / "elsewhere.csv"
    assert (middle.record.name, str(campaign.record_at(middle.record))) == (
        "stated.csv",
        "middle in memory",
    )


def test_record_names_are_valid_and_unique_file_names(tmp_path):
    document = frames.parse_description_without_truth()
    document["runs"] = [
        {"name": "10 g / in", "rate": "1 rad/s"},
        {"name": "10 g , in", "rate": "2 rad/s"},
        {"name": "..", "rate": "3 rad/s"},
    ]
    columns = frames.simulate_columns(tmp_path)["slow"]
    campaign = make_campaign(document, {run["name"]: columns for run in document["runs"]})
    names = [run.record.name for run in campaign.runs]
    assert names == ["10_g_in.parquet", "10_g_in-2.parquet", "run.parquet"]


def test_description_in_file_accepts_records_in_memory(tmp_path):
    records = frames.simulate_columns(tmp_path)
    file = campaigns.write_description(tmp_path, campaigns.SMALL)
    campaign = make_campaign(tmp_path, {"slow": records["slow"]})
    assert campaign.source.file == file
    assert [str(campaign.record_at(run.record)) for run in campaign.runs] == [
        "slow in memory",
        str(tmp_path / "middle.csv"),
        str(tmp_path / "fast.csv"),
    ]


def test_quantity_objects_are_accepted():
    document = frames.parse_small_description()
    document["centrifuge"]["radius"] = Quantity(2.5, 1e-5, "m")
    assert make_campaign(document).radius == Quantity(2.5, 1e-5, "m")


def test_errors_match_those_of_file(tmp_path):
    text = campaigns.replace_parts(
        campaigns.SMALL, ('radius = "2.5 m"', 'radius = "2.5 s"'), ("[noise]", "[nose]")
    )
    with pytest.raises(CampaignError) as of_file:
        read_campaign(campaigns.write_description(tmp_path, text))
    document = frames.parse_small_description()
    document["centrifuge"]["radius"] = "2.5 s"
    document["nose"] = document.pop("noise")
    with pytest.raises(CampaignError) as error_info:
        make_campaign(document)
    assert set(error_info.value.problems) == set(of_file.value.problems)
    assert str(error_info.value).startswith("campaign in memory: 2 mistakes")


@pytest.mark.parametrize(
    ("records", "message"),
    [
        ({"slwo": {}}, r'records: no run is named "slwo"; did you mean "slow"\?'),
        ({}, r'runs\[0\].record: is missing \(run "slow"\)'),
    ],
)
def test_rejects_records_that_do_not_match_runs(records, message):
    with pytest.raises(CampaignError, match=message):
        make_campaign(frames.parse_description_without_truth(), records)


def test_invalid_frame_names_run():
    with raises("wrong-type", "slow in memory:", "list"):
        make_campaign(frames.parse_description_without_truth(), {"slow": [1.0]})


def test_rejects_values_without_toml_type():
    with raises("invalid-value", "campaign.title:", "NUL"):
        make_campaign(frames.parse_small_description() | {"campaign": {"title": "a\0"}})
    with raises("wrong-type", "runs:", "set"):
        make_campaign(frames.parse_small_description() | {"runs": {1}})


def test_runs_without_record_get_default_name():
    document = frames.parse_description_without_truth()
    document["runs"][0]["name"] = "a/b"
    document["runs"][1]["name"] = "a:b"
    campaign = make_campaign(document)
    assert [run.record.name for run in campaign.runs] == [
        "a_b.parquet",
        "a_b-2.parquet",
        "fast.parquet",
    ]
