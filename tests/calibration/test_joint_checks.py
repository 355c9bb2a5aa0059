"""Checks of a joint result, with constructed fits where possible."""

from types import SimpleNamespace

import numpy as np
import pytest
from mistaken_campaigns import Mistake, make_mistaken_campaign, make_records

from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.joint import check_unrecorded_ripple
from counterspin.campaign.memory import make_campaign
from counterspin.simulation.simulate import simulate


def make_view(fit: SimpleNamespace, campaign: SimpleNamespace | None = None) -> AccelerometerView:
    """Return the view of the fit for Qx."""
    return AccelerometerView(
        SimpleNamespace(campaign=campaign), SimpleNamespace(fit=fit), None, "Qx"
    )


def make_campaign_view(observable: str, angle: object | None) -> AccelerometerView:
    """Return a campaign view at 10 g with its K_II."""
    campaign = SimpleNamespace(
        accelerometers={"Qx": SimpleNamespace(observable=observable)},
        angle=angle,
        radius=SimpleNamespace(value=2.5),
        gravity=SimpleNamespace(value=9.8),
        runs=[SimpleNamespace(rate=rate) for rate in (np.pi, -2 * np.pi)],
    )
    unknown = SimpleNamespace(owner="Qx", symbol="K_II", is_of_interest=True)
    fit = SimpleNamespace(
        model=SimpleNamespace(unknowns=[unknown]), solution=SimpleNamespace(u=np.array([2e-9]))
    )
    return make_view(fit, campaign)


def test_unrecorded_ripple_is_finding():
    (finding,) = check_unrecorded_ripple(make_campaign_view("specific_force", None))
    # At 10 g a ripple of 1e-8 of the rate is 1e-9 g/g^2.
    assert "relative rate ripple of 1e-08" in finding.text


@pytest.mark.parametrize(
    ("observable", "angle"), [("specific_force", object()), ("displacement", None)]
)
def test_recorded_angle_or_displacement_has_no_finding(observable, angle):
    assert check_unrecorded_ripple(make_campaign_view(observable, angle)) == []


def test_run_without_information_on_k_ii_has_no_z():
    """An upright accelerometer has 1 g in each run, so K_II equals its prior in all fits.

    Rounding errors of a shift and of its u do not define z.
    """
    known = make_campaign(
        {
            "site": {"gravity": "9.8 m/s^2", "latitude": "45 deg"},
            "centrifuge": {"radius": "1 m"},
            "noise": {"displacement": "2 mm"},
            "records": {
                "time": {"column": "t", "unit": "s"},
                "angle": {"column": "angle", "unit": "rad"},
            },
            "accelerometers": {
                "Qz": {
                    "input_axis": "up",
                    "pendulous_axis": "east",
                    "K_II": "2e-5 ± 2e-5 g/g^2",
                    "displacement": {"column": "z", "unit": "m"},
                }
            },
            "model": {"terms": ["K_F", "K_I", "K_II"]},
            "simulation": {"revolutions": 10, "sampling_rate": "10 Hz"},
            "truth": {"Qz": {"K_II": "3e-5 g/g^2"}},
            "runs": [{"name": f"{rate}", "rate": f"{rate} rev/s"} for rate in (0.3, 0.6, 1)],
        }
    )
    jackknife = calibrate(simulate(known)).accelerometers["Qz"].jackknife
    assert len(jackknife) == 3
    assert all(each.z is None and abs(each.shift) < 1e-11 for each in jackknife)


def test_two_stage_comparison_uses_model_of_joint_fit(tmp_path):
    """The joint fit has a requested drift of 100 typical sizes; two stages have no t^3 term.

    With the joint estimate of the drift, the differences of both K_II have the stated u.
    """
    terms = '"platform.tilt"]'
    replacement = (terms, '"platform.tilt", "platform.drift"]')
    drift = 'drift = { north = "1 deg/h", east = "-1 deg/h" }'
    drifting = ("[truth.spindle]", f"[truth.platform]\n{drift}\n\n[truth.spindle]")
    distances = []
    for seed in range(11, 19):
        again = ("seed = 3", f"seed = {seed}")
        records = make_records(tmp_path / f"{seed}", replacement, drifting, again)
        mistake = Mistake("", "", description=(replacement,))
        result = calibrate(make_mistaken_campaign(tmp_path / f"{seed} stated", mistake, records))
        beside = [accelerometer.two_stage for accelerometer in result.accelerometers.values()]
        distances += [one.z for one in beside]
        assert "methods-disagree" not in {finding.code for finding in result.findings}
    # Chi-square of 16: below 3.9 and above 39 each with p = 0.001. Two stages without
    # the joint estimate had 8e3.
    assert 3.9 < np.sum(np.square(distances)) < 39.3
