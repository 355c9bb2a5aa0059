"""Changing a campaign in memory: merge patches and records."""

from dataclasses import replace

import campaigns
import frames
import pytest

from counterspin.campaign.description import read_campaign
from counterspin.campaign.memory import make_campaign
from counterspin.campaign.quantity import Quantity
from counterspin.errors import CampaignError, CounterspinError


@pytest.fixture
def campaign():
    return make_campaign(frames.parse_small_description())


def test_mapping_changes_listed_keys(campaign):
    changed = campaign.change(
        {
            "campaign": {"title": "Other"},
            "site": {"gravity": "9.81 m/s^2"},
            "centrifuge": {"radius": Quantity(2.6, 1e-5, "m")},
            "noise": {"displacement": "0.02 m", "angle": "1e-6 rad"},
            "records": {"time": {"unit": "ms"}},
            "accelerometers": {"Qx": {"serial_number": "7"}},
            "truth": {"Qx": {"K_II": "5e-5 g/g^2"}},
        }
    )
    assert changed.title == "Other"
    assert (changed.gravity.value, changed.site.gravity) == (9.81, 9.81)
    assert changed.radius == Quantity(2.6, 1e-5, "m")
    assert changed.noise.displacement == 0.02
    assert changed.time.factor == 1e-3
    assert list(changed.accelerometers) == ["Qx", "Qy"]
    assert changed.accelerometers["Qx"].serial_number == "7"
    assert changed.simulation.truth.coefficients["Qx"]["K_II"] == 5e-5
    # Other keys and the original campaign are unchanged.
    before = campaign.simulation.truth.coefficients
    assert changed.simulation.truth.coefficients["Qx"]["K_F"] == before["Qx"]["K_F"]
    assert changed.latitude == campaign.latitude
    assert campaign.radius.value == 2.5


def test_none_removes_key(campaign):
    assert campaign.change({"noise": None}).noise is None
    assert campaign.change({"model": {"assume": None}}).model.assume == ()
    assert list(campaign.change(campaigns.WITHOUT_QY).accelerometers) == ["Qx"]


def test_list_replaces_list(campaign):
    runs = campaigns.find_runs(campaign, "slow", "fast")
    fewer = campaign.change({"runs": [runs[0], runs[1] | {"rate": "2 rad/s"}]})
    assert [run.name for run in fewer.runs] == ["slow", "fast"]
    assert fewer.runs[1].rate == 2.0
    assert campaign.change({"model": {"terms": ["K_F"]}}).model.terms == ("K_F",)


def test_records_in_memory_are_preserved_or_replaced(tmp_path):
    records = frames.simulate_columns(tmp_path)
    campaign = make_campaign(frames.parse_description_without_truth(), records).change(
        {"centrifuge": {"radius": "2.4 m"}}
    )
    assert [str(campaign.record_at(run.record)) for run in campaign.runs] == [
        "slow in memory",
        "middle in memory",
        "fast in memory",
    ]
    fewer = campaign.change({"runs": campaigns.find_runs(campaign, "fast")})
    assert len(fewer.frames) == 1
    new_campaign = make_campaign(frames.parse_small_description(), folder=tmp_path)
    given = new_campaign.change({}, records={"slow": records["slow"]})
    assert list(given.frames) == [tmp_path / "slow.csv"]


def test_changed_campaign_keeps_files(tmp_path):
    campaigns.write_description(tmp_path, campaigns.SMALL)
    changed = read_campaign(tmp_path).change({"centrifuge": {"radius": "2.6 m"}})
    assert changed.runs[0].record == tmp_path / "slow.csv"
    assert changed.title == tmp_path.name


def test_all_errors_are_reported(campaign):
    with pytest.raises(CampaignError) as wrong:
        campaign.change(
            {"centrifuge": {"radius": "2.5 s"}, "model": {"terms": ["K_2"]}, "nois": {}},
            records={"slwo": {}},
        )
    problems = wrong.value.problems
    assert [line.partition(": ")[0] for line in problems] == ["records"]
    assert problems[0].endswith('"slwo"; did you mean "slow"?')
    with pytest.raises(CampaignError) as wrong:
        campaign.change(
            {"centrifuge": {"radius": "2.5 s"}, "model": {"terms": ["K_2"]}, "nois": {}}
        )
    starts = {line.partition(": ")[0] for line in wrong.value.problems}
    assert {"centrifuge.radius", "model.terms[0]", "nois"} <= starts


def test_rejects_change_of_campaign_without_description(campaign):
    for act in (lambda c: c.change({}), lambda c: c.write("anywhere")):
        with pytest.raises(CounterspinError, match="its description is unknown"):
            act(replace(campaign, title="other"))
