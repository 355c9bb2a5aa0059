"""What further runs would give is what a calibration with them states."""

import pytest
from campaigns import SMALL, replace_parts
from recorded_campaigns import simulate_measured_campaign

from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.description import read_campaign
from counterspin.planning.recorded import observe_with_noise, suggest_runs
from counterspin.toml_text import format_document

#: Nothing is taken as perfect: K_OO, 2 ug/g^2, looks like K_II.
HONEST = replace_parts(SMALL, ('[model]\nassume = "all"\n', ""))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return simulate_measured_campaign(
        tmp_path_factory.mktemp("recorded"), tmp_path_factory.mktemp("plan"), HONEST
    )


def suggest_further_runs(campaign, name="Qx.K_II"):
    return suggest_runs(campaign, *observe_with_noise(campaign), name)


def test_further_runs_reach_promised_u(recorded, tmp_path):
    further_runs = suggest_further_runs(read_campaign(recorded))
    before = calibrate(recorded).accelerometers["Qx"].coefficients["K_II"].u
    assert further_runs.u_without_runs == pytest.approx(before, rel=1e-3)
    assert further_runs.u < 0.8 * before
    more = [dict(run) for run in further_runs.runs]
    for run in more:
        run["revolutions"] = 20
        assert float(run.pop("duration").split()[0]) > 0.0
    text = HONEST.replace("[simulation]", f"{format_document({'runs': more})}\n[simulation]")
    after = calibrate(simulate_measured_campaign(tmp_path / "more", tmp_path / "plan", text))
    assert after.accelerometers["Qx"].coefficients["K_II"].u == pytest.approx(
        further_runs.u, rel=1e-2
    )


def test_complete_campaign_needs_no_further_attitude(recorded):
    perfect = read_campaign(recorded).change(
        {"model": {"assume": ["all"], "priors": {"Qx.K_II": "0 ± 1e-12 g/g^2"}}}
    )
    assert suggest_further_runs(perfect) is None
