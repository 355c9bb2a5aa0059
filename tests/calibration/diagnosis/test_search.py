"""Good campaigns are blamed for nothing, and nothing is searched where nothing is suspicious."""

import math
import os
from dataclasses import replace

import numpy as np
import pytest
from campaigns import changed
from mistaken_campaigns import NOISE, SOUND, Mistake, make_records, mistaken
from results import accelerometer

from counterspin.calibration.diagnosis import search
from counterspin.calibration.joint_checks import residual_findings
from counterspin.calibration.joint_parts import noise_lines, residual
from counterspin.calibration.joint_problem import noise_of, series_of
from counterspin.calibration.joint_view import AccelerometerView
from counterspin.calibration.model import model_of
from counterspin.calibration.observed import observe
from counterspin.campaign.description import read_campaign
from counterspin.inference.identifiability import assess
from counterspin.inference.joint.estimation import estimate
from counterspin.physics.simulation import accelerometer_walk

FULL = bool(os.environ.get("COUNTERSPIN_FULL"))
WHITE = 0.01
SILENT = ('displacement = "0.01 m"\nangle', 'displacement = "0 m"\nangle')


class Campaigns:
    """Honest campaigns: truths drawn from their priors, noise as it is."""

    def __init__(self, folder, text, walk):
        records = make_records(folder / "sound", SILENT)
        where = mistaken(folder / "own", Mistake("", ""), records)
        (where / "campaign.toml").write_text(text, encoding="utf-8")
        self.campaign = read_campaign(where / "campaign.toml")
        self.clean = series_of(self.campaign, list(observe(self.campaign)))
        self.model, self.walk, self.columns = model_of(self.campaign), walk, {}

    def drawn(self, rng):
        """Return the causes that are found in one of them."""
        known = [u for u in self.model.unknowns if math.isfinite(u.prior[1])]
        off = {unknown: unknown.prior[1] * rng.standard_normal() for unknown in known}
        series = [self._noisy(i, one, off, rng) for i, one in enumerate(self.clean)]
        found = estimate(series, self.model, noise_of(self.campaign))
        names = [unknown.name for unknown in self.model.asked]
        determined = assess(found.fit.solution, names)
        views = [
            AccelerometerView(self.campaign, found, determined, name)
            for name in self.campaign.accelerometers
        ]
        return search.causes_of(views, {view.name: result_of(view) for view in views})

    def _noisy(self, i, one, off, rng):
        error = one.error + WHITE / np.sqrt(one.count) * rng.standard_normal(one.error.size)
        for unknown, size in off.items():
            if unknown.concerns(one):
                if (i, unknown) not in self.columns:
                    self.columns[i, unknown] = one.columns([unknown.symbol], 1.0)[:, 0]
                error += size * self.columns[i, unknown]
        if self.walk:
            error += accelerometer_walk(rng, one.time, self.walk, one.order)
        return replace(one, error=error)


def result_of(view):
    return accelerometer(
        residual=residual(view),
        noise=noise_lines(view),
        jackknife=view.jackknife(),
        findings=residual_findings(view),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "walk", "trials"),
    [
        (True, 0.0, 400 if FULL else 24),
        (False, 0.0, 200 if FULL else 3),
        (False, 3e-5, 200 if FULL else 3),
    ],
)
def test_good_campaigns_are_blamed_in_one_of_a_hundred(given, walk, trials, tmp_path):
    text = SOUND if given else changed(SOUND, (NOISE, ""))
    campaigns = Campaigns(tmp_path, text, walk)
    rng = np.random.default_rng(5)
    blamed = sum(bool(campaigns.drawn(rng)) for _ in range(trials))
    # At 1 % each; so many or more come in fewer than one of 10,000 such studies (Poisson).
    mean = 0.01 * trials
    chance, term = 1.0, math.exp(-mean)
    for k in range(blamed):
        chance -= term
        term *= mean / (k + 1)
    assert chance > 1e-4


def test_where_nothing_is_suspicious_nothing_is_tried(tmp_path, monkeypatch):
    campaigns = Campaigns(tmp_path, SOUND, 0.0)
    monkeypatch.setattr(search, "_others", lambda *_: pytest.fail("alternatives were tried"))
    monkeypatch.setattr(search, "_is_suspicious", lambda *_: False)
    for seed in range(3):
        assert campaigns.drawn(np.random.default_rng(seed)) == ()
