from dataclasses import replace

import campaigns
import frames
import numpy as np
import pytest

from counterspin.campaign.description import read_campaign
from counterspin.campaign.memory.making import make_campaign
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
