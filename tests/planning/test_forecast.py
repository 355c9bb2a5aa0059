"""Forecasts: a campaign of records and readings is foretold as it is calibrated."""

import pytest
from mixed_campaign import MixedCampaign

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
