"""A table of readings as a frame: the same campaign as with the table as a file."""

import tomllib

import pandas as pd
import polars as pl
import pytest
from raising import raises

import counterspin as cs
from counterspin.errors import CampaignError


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("tumble")
    cs.simulate(cs.init(place / "made", test="tumble"), place / "records")
    return place / "records"


@pytest.fixture(scope="module")
def table(folder):
    return pl.read_csv(folder / "readings.csv", comment_prefix="#")


@pytest.fixture
def description(folder):
    document = tomllib.loads((folder / "campaign.toml").read_text(encoding="utf-8"))
    del document["readings"]["file"]
    return document


def test_the_result_is_that_of_the_file(folder, table, description, tmp_path):
    own = cs.calibrate(folder)
    mapping = table.to_dict(as_series=False)
    for frame in (table, pd.DataFrame(mapping), mapping):
        campaign = cs.make_campaign(description, readings=frame)
        found = cs.calibrate(campaign)
        for name, accelerometer in own.accelerometers.items():
            assert found.accelerometers[name].coefficients == accelerometer.coefficients
    assert list(found.provenance.inputs) == ["campaign.toml"]
    campaign.write(tmp_path / "written")
    again = cs.calibrate(tmp_path / "written")
    assert again.accelerometers == found.accelerometers
    assert again.provenance.inputs == found.provenance.inputs


def test_mistakes_are_told_with_their_row(table, description):
    wrong = table.with_columns(pl.lit("much").alias(table.columns[-1]))
    with pytest.raises(CampaignError, match="in memory row 1"):
        cs.make_campaign(description, readings=wrong)
    with pytest.raises(CampaignError, match="has no column"):
        cs.make_campaign(description, readings=table.select(table.columns[0]))
    named = description | {"readings": description["readings"] | {"file": "readings.csv"}}
    with raises("conflicting-keys", "readings:", "file"):
        cs.make_campaign(named, readings=table)
    without = {key: value for key, value in description.items() if key != "readings"}
    with pytest.raises(CampaignError, match="readings: is missing"):
        cs.make_campaign(without, readings=table)
    with pytest.raises(CampaignError, match="differ in length"):
        cs.make_campaign(description, readings={"a": [1.0], "b": [1.0, 2.0]})
