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
    return make_campaign(frames.small())


def test_short_names_and_sections(campaign):
    changed = campaign.change(
        title="Other",
        radius=Quantity(2.6, 1e-5, "m"),
        gravity="9.81 m/s^2",
        latitude="30 deg",
        noise={"displacement": "0.02 m", "angle": "1e-6 rad"},
        seed=7,
        sampling_rate="40 Hz",
        truth={"Qx": {"K_II": "5e-5 g/g^2"}},
    )
    assert changed.title == "Other"
    assert changed.radius == Quantity(2.6, 1e-5, "m")
    assert (changed.gravity.value, changed.site.gravity) == (9.81, 9.81)
    assert changed.noise.displacement == 0.02
    assert (changed.simulation.seed, changed.simulation.sampling_rate) == (7, 40.0)
    assert changed.simulation.truth.coefficients["Qx"]["K_II"] == 5e-5
    # What was not named stays.
    before = campaign.simulation.truth.coefficients
    assert changed.simulation.truth.coefficients["Qx"]["K_F"] == before["Qx"]["K_F"]
    assert campaign.radius.value == 2.5


def test_none_takes_away_and_dots_reach_any_key(campaign):
    assert campaign.change(noise=None).noise is None
    changed = campaign.change(**{"records.time.unit": "ms", "accelerometers.Qx.serial_number": "7"})
    assert changed.time.factor == 1e-3
    assert changed.accelerometers["Qx"].serial_number == "7"


def test_terms_and_priors(campaign):
    terms = ["K_F", "K_I", "K_II", "platform.tilt"]
    changed = campaign.change(
        terms=terms, considered=["K_PP"], priors={"K_PP": "0 ± 2e-6 g/g^2", "K_I": "1 ± 1e-4 g/g"}
    )
    assert changed.model.terms[:3] == ("K_F", "K_I", "K_II")
    assert changed.model.considered == ("K_PP",)
    for accelerometer in changed.accelerometers.values():
        # In the place of `scale_factor`, which the accelerometers' own tables have.
        assert accelerometer.priors["K_I"] == Quantity(1.0, 1e-4, "g/g")
    one = campaign.change(priors={"Qx.K_I": "1 ± 1e-4 g/g"}).accelerometers
    assert (one["Qx"].priors["K_I"].u, one["Qy"].priors["K_I"].value) == (1e-4, 0.999)
    assert "K_I" not in campaign.change(priors={"K_I": None}).accelerometers["Qx"].priors


def test_priors_of_terms_that_are_asked_for_no_more_are_kept(campaign):
    tilt = {"platform.tilt": "0 ± 1 arcsec", "Qx.K_II": "0 ± 1e-4 g/g^2"}
    wide = campaign.change(terms=["K_F", "K_I", "K_II", "platform.tilt"], priors=tilt)
    narrow = wide.change(terms=["K_F", "K_I", "K_II", "platform.tilt.north"])
    assert narrow.model.priors == wide.model.priors
    assert set(narrow.model.priors) == {f"platform.tilt.{axis}" for axis in ("east", "north", "up")}
    bare = wide.change(terms=["K_F", "K_I", "K_III"])
    assert bare.model.priors == wide.model.priors
    assert bare.accelerometers["Qx"].priors["K_II"].u == 1e-4
    gone = wide.change(terms=["K_F", "K_I", "K_III"], priors=dict.fromkeys(tilt))
    assert gone.model.priors == {}
    assert "K_II" not in gone.accelerometers["Qx"].priors


def test_what_is_assumed_and_what_is_held(campaign):
    assert campaign.model.assume == ("all",)
    some = campaign.change(assume=["K_OO", "platform.*"])
    assert some.model.assume == ("K_OO", "platform.*")
    assert campaign.change(assume=None).model.assume == ()
    known = {"K_PP": "0 ± 1e-6 g/g^2"}
    held = some.change(hold=["K_PP"], priors=known)
    assert held.model.considered == ("K_PP",)
    assert some.change(considered=["K_PP"], priors=known).model == held.model
    with pytest.raises(CampaignError, match="is the old name of hold; keep hold alone"):
        held.change(considered=["K_PP"])


def test_one_accelerometer_of_two(campaign):
    specified = campaign.change(
        specification={"Qy": {"K_II": "abs <= 1e-4 g/g^2"}},
        priors={"Qy.K_II": "0 ± 1e-4 g/g^2"},
    )
    for names in (["Qx"], "Qx"):
        only = specified.change(accelerometers=names)
        assert list(only.accelerometers) == ["Qx"]
        assert list(only.simulation.truth.coefficients) == ["Qx"]
    swapped = campaign.change(accelerometers=["Qy", "Qx"])
    assert list(swapped.accelerometers) == ["Qy", "Qx"]


def test_noise_goes_with_the_only_accelerometer_that_has_it():
    document = frames.small()
    table = document["accelerometers"]["Qy"]
    del table["displacement"]
    table["velocity"] = {"column": "north_m_s", "unit": "m/s"}
    document["noise"]["velocity"] = "1e-3 m/s"
    campaign = make_campaign(document)
    assert campaign.noise.velocity == 1e-3
    assert campaign.change(accelerometers=["Qx"]).noise.velocity == 0.0


def test_an_accelerometer_is_changed_by_name(campaign):
    changed = campaign.change(accelerometers={"Qx": {"bias": "0.005 ± 1e-6 g"}})
    assert changed.accelerometers["Qx"].priors["K_F"] == Quantity(0.005, 1e-6, "g")
    assert list(changed.accelerometers) == ["Qx", "Qy"]


def test_runs(campaign):
    assert [run.name for run in campaign.change(runs=["fast", "slow"]).runs] == ["fast", "slow"]
    fewer = campaign.change(runs={"slow": None, "fast": {"rate": "2 rad/s"}})
    assert [(run.name, run.rate) for run in fewer.runs][1] == ("fast", 2.0)
    assert len(fewer.runs) == 2
    other = campaign.change(runs=[{"name": "one", "rate": "1 rad/s", "record": "one.csv"}])
    assert [run.name for run in other.runs] == ["one"]


def test_records_in_memory_are_kept_and_given(tmp_path):
    records = frames.arrays(tmp_path)
    campaign = make_campaign(frames.untrue(), records).change(radius="2.4 m")
    assert [str(campaign.record_at(run.record)) for run in campaign.runs] == [
        "slow in memory",
        "middle in memory",
        "fast in memory",
    ]
    fewer = campaign.change(runs=["fast"])
    assert len(fewer.frames) == 1
    given = make_campaign(frames.small(), folder=tmp_path).change(records={"slow": records["slow"]})
    assert list(given.frames) == [tmp_path / "slow.csv"]


def test_a_campaign_of_files_keeps_them(tmp_path):
    campaigns.write(tmp_path, campaigns.SMALL)
    changed = read_campaign(tmp_path).change(radius="2.6 m")
    assert changed.runs[0].record == tmp_path / "slow.csv"
    assert changed.title == tmp_path.name


def test_mistakes_are_all_told(campaign):
    with pytest.raises(CampaignError) as wrong:
        campaign.change(tems=[], runs=["slwo"], accelerometers=["Qxx"], records=3)
    assert wrong.value.problems == (
        'tems: cannot be changed; did you mean "terms"?',
        'runs: there is no "slwo"; did you mean "slow"?',
        'accelerometers: there is no "Qxx"; did you mean "Qx"?',
        "records: must be a mapping from runs' names to records",
    )
    with pytest.raises(CampaignError) as wrong:
        campaign.change(radius="2.5 s", terms=["K_2"])
    starts = [line.partition(": ")[0] for line in wrong.value.problems]
    assert starts[:2] == ["centrifuge.radius", "model.terms[0]"]


def test_a_campaign_without_its_description_is_not_changed(campaign):
    for act in (lambda c: c.change(radius="2 m"), lambda c: c.write("anywhere")):
        with pytest.raises(CounterspinError, match="its description is unknown"):
            act(replace(campaign, title="other"))
