"""Forecasts: a campaign of records and readings is foretold as it is calibrated."""

import pytest
from campaigns import SMALL, changed, write
from mixed_campaign import MixedCampaign

from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.simulation import simulate
from counterspin.planning.forecast import forecast


def test_a_mixed_campaign_has_the_uncertainties_that_were_forecast(tmp_path):
    """Records on a double turntable, readings on an arm and at rest: every u, and the budget's."""
    mixed = MixedCampaign(tmp_path)
    result = mixed.calibrated()
    folder = tmp_path / "all"
    text = (folder / "campaign.toml").read_text(encoding="utf-8")
    planned = text.replace('record = "run', 'revolutions = 20\nrecord = "run')
    (folder / "campaign.toml").write_text(planned, encoding="utf-8")
    told = forecast(folder, sampling_rate=10.0)
    for symbol, c in result.accelerometers["A"].coefficients.items():
        # Records are reduced to block means and know their own rotation; a forecast samples.
        assert c.u == pytest.approx(told.u[f"A.{symbol}"], rel=5e-3)


def test_a_computer_with_its_own_velocity_makes_no_difference(tmp_path):
    """What it took off is put back, noise included: a forecast, or a study, need not know of it."""
    walk = 'acceleration = "1e-5 g/Hz^0.5"\n'
    calibrated, told = [], []
    for reference in ("platform", "own velocity"):
        folder = tmp_path / reference
        text = changed(
            SMALL,
            ("[records]\n", f'[records]\nreference = "{reference}"\n'),
            ("[noise]\n", f"[noise]\n{walk}"),
            ("[truth.noise]\n", f"[truth.noise]\n{walk}"),
        )
        simulate(write(folder, text), folder)
        calibrated.append(calibrate(folder))
        told.append(forecast(folder).u)
    assert told[0] == told[1]
    given, own = (result.accelerometers for result in calibrated)
    for name, accelerometer in given.items():
        for symbol in ("K_F", "K_II", "K_III"):
            c, other = accelerometer.coefficients[symbol], own[name].coefficients[symbol]
            assert other.value != c.value
            assert other.value == pytest.approx(c.value, abs=0.01 * c.u)
            assert other.u == pytest.approx(told[1][f"{name}.{symbol}"], rel=5e-3)
