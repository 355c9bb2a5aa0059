"""A table of readings as a frame: the same campaign as with the table as a file."""

import tomllib

import pandas as pd
import polars as pl
import pytest
from raising import raises

import counterspin as cs
from counterspin.errors import CampaignError


@pytest.fixture(scope="module")
def example_folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("tumble")
    cs.simulate(cs.init(place / "made", test="tumble"), place / "records")
    return place / "records"


@pytest.fixture(scope="module")
def reading_table(example_folder):
    return pl.read_csv(example_folder / "readings.csv", comment_prefix="#")


@pytest.fixture
def description_text(example_folder):
    document = tomllib.loads((example_folder / "campaign.toml").read_text(encoding="utf-8"))
    del document["readings"]["file"]
    return document


def test_result_equals_result_from_file(example_folder, reading_table, description_text, tmp_path):
    own = cs.calibrate(example_folder)
    mapping = reading_table.to_dict(as_series=False)
    for frame in (reading_table, pd.DataFrame(mapping), mapping):
        campaign = cs.make_campaign(description_text, readings=frame)
        result = cs.calibrate(campaign)
        for name, accelerometer in own.accelerometers.items():
            assert result.accelerometers[name].coefficients == accelerometer.coefficients
    assert list(result.provenance.inputs) == ["campaign.toml"]
    campaign.write(tmp_path / "written")
    again = cs.calibrate(tmp_path / "written")
    assert again.accelerometers == result.accelerometers
    assert again.provenance.inputs == result.provenance.inputs


def test_errors_name_row(reading_table, description_text):
    wrong = reading_table.with_columns(pl.lit("much").alias(reading_table.columns[-1]))
    with pytest.raises(CampaignError, match="in memory row 1"):
        cs.make_campaign(description_text, readings=wrong)
    with pytest.raises(CampaignError, match="has no column"):
        cs.make_campaign(description_text, readings=reading_table.select(reading_table.columns[0]))
    named = description_text | {"readings": description_text["readings"] | {"file": "readings.csv"}}
    with raises("conflicting-keys", "readings:", "file"):
        cs.make_campaign(named, readings=reading_table)
    without = {key: value for key, value in description_text.items() if key != "readings"}
    with pytest.raises(CampaignError, match="readings: is missing"):
        cs.make_campaign(without, readings=reading_table)
    with pytest.raises(CampaignError, match="differ in length"):
        cs.make_campaign(description_text, readings={"a": [1.0], "b": [1.0, 2.0]})
