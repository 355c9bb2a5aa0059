"""Good campaigns have no cause, and without a suspicious check there is no search."""

import math
import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from campaigns import replace_parts
from mistaken_campaigns import (
    CORRECT_DESCRIPTION,
    NOISE,
    RUNS,
    Mistake,
    make_mistaken_campaign,
    make_records,
)
from results import make_accelerometer_result

from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.checks.residuals import residual_findings
from counterspin.calibration.diagnosis import ranking, search
from counterspin.calibration.joint_problem import JointProblem, make_noise, make_series
from counterspin.calibration.model import make_unknowns
from counterspin.calibration.observed_runs import observe_runs
from counterspin.calibration.outcome import noise_lines, summarize_residuals
from counterspin.campaign.description import read_campaign
from counterspin.inference.identifiability import assess
from counterspin.inference.joint import mistakes
from counterspin.inference.joint.alternatives import Alternative, ScoreTests, prior_alternatives
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.fit import estimate_considered
from counterspin.inference.joint.unknowns import Considered
from counterspin.inference.noise.simulation import draw_accelerometer_noise

FULL = bool(os.environ.get("COUNTERSPIN_FULL"))
WHITE = 0.01
SILENT = ('displacement = "0.01 m"\nangle', 'displacement = "0 m"\nangle')


class Campaigns:
    """Good campaigns: truths drawn from their priors and noise as stated."""

    def __init__(self, folder, text, walk):
        records = make_records(folder / "sound", SILENT)
        where = make_mistaken_campaign(folder / "own", Mistake("", ""), records)
        (where / "campaign.toml").write_text(text, encoding="utf-8")
        self.campaign = read_campaign(where / "campaign.toml")
        self.clean = make_series(self.campaign, list(observe_runs(self.campaign)))
        self.model, self.walk, self.columns = make_unknowns(self.campaign), walk, {}

    def draw_causes(self, rng):
        """Return the causes found in a random campaign."""
        known = [u for u in self.model.unknowns if math.isfinite(u.prior[1])]
        off = {unknown: unknown.prior[1] * rng.standard_normal() for unknown in known}
        series = [self._noisy(i, one, off, rng) for i, one in enumerate(self.clean)]
        estimation = estimate(series, self.model, make_noise(self.campaign))
        names = [unknown.name for unknown in self.model.of_interest]
        determined = assess(estimation.fit.solution, names)
        views = [
            AccelerometerView(JointProblem(self.campaign), estimation, determined, name)
            for name in self.campaign.accelerometers
        ]
        return search.find_causes(views, {view.name: make_accelerometer(view) for view in views})

    def _noisy(self, i, one, off, rng):
        error = one.error + WHITE / np.sqrt(one.count) * rng.standard_normal(one.error.size)
        for unknown, size in off.items():
            if unknown.affects(one):
                if (i, unknown) not in self.columns:
                    self.columns[i, unknown] = one.columns([unknown.symbol], 1.0)[:, 0]
                error += size * self.columns[i, unknown]
        if self.walk:
            error += draw_accelerometer_noise(rng, one.time, self.walk, one.order)
        return replace(one, error=error)


def make_accelerometer(view):
    return make_accelerometer_result(
        residual=summarize_residuals(view),
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
def test_false_alarm_rate_of_good_campaigns_is_1_percent(given, walk, trials, tmp_path):
    text = CORRECT_DESCRIPTION if given else replace_parts(CORRECT_DESCRIPTION, (NOISE, ""))
    campaigns = Campaigns(tmp_path, text, walk)
    rng = np.random.default_rng(5)
    blamed = sum(bool(campaigns.draw_causes(rng)) for _ in range(trials))
    # At 1 % each, this number or more occurs in fewer than 1 of 10,000 studies (Poisson).
    mean = 0.01 * trials
    chance, term = 1.0, math.exp(-mean)
    for k in range(blamed):
        chance -= term
        term *= mean / (k + 1)
    assert chance > 1e-4


def test_no_search_without_suspicious_checks(tmp_path, monkeypatch):
    campaigns = Campaigns(tmp_path, CORRECT_DESCRIPTION, 0.0)
    monkeypatch.setattr(
        search, "_alternative_hypotheses", lambda *_: pytest.fail("alternatives were tried")
    )
    monkeypatch.setattr(search, "_is_suspicious", lambda *_: False)
    for seed in range(3):
        assert campaigns.draw_causes(np.random.default_rng(seed)) == ()


def test_alternatives_have_credible_range(tmp_path):
    """The range of an input is physical: latitudes up to the poles, gravity on the Earth."""
    given = Campaigns(tmp_path, CORRECT_DESCRIPTION, 0.0)
    estimation = estimate(given.clean, given.model, make_noise(given.campaign))
    now = replace(estimation, fit=estimate_considered(estimation.fit), compressed_fit=None)
    names = [unknown.name for unknown in given.model.of_interest]
    determined = assess(estimation.fit.solution, names)
    views = [
        AccelerometerView(JointProblem(given.campaign), estimation, determined, name)
        for name in given.campaign.accelerometers
    ]
    others = [*prior_alternatives(now.fit), *search._alternative_hypotheses(views, now)]
    every = search._set_ranges(given.campaign, others)
    assert len(every) > 100
    assert all(math.isfinite(end) for other in every for end in other.credible_range)
    latitude, gravity = (
        next(other for other in every if other.symbol == symbol)
        for symbol in ("site.latitude", "site.gravity")
    )
    assert latitude.is_credible(math.radians(10.0))
    assert not latitude.is_credible(math.radians(12.0))
    assert not latitude.is_credible(math.radians(-4200.0))
    # For 45.75 deg: latitudes with 9.8066 m/s^2 between -500 and 3000 m, also in the south.
    degrees = np.linspace(-90.0, 90.0, 361) - 45.75
    allowed = [float(d) + 45.75 for d in degrees if latitude.is_credible(math.radians(float(d)))]
    assert min(abs(d) for d in allowed) == pytest.approx(42.7, abs=0.5)
    assert max(allowed) == -min(allowed) == pytest.approx(57.1, abs=0.5)
    # Normal gravity at 45.75 deg: 9.79763 m/s^2 at 3000 m, 9.80842 at -500 m; and 1e-3 more.
    assert gravity.is_credible(9.80842 - 9.8066 + 0.9e-3)
    assert not gravity.is_credible(9.80842 - 9.8066 + 1.1e-3)
    assert gravity.is_credible(9.79763 - 9.8066 - 0.9e-3)
    assert not gravity.is_credible(9.79763 - 9.8066 - 1.1e-3)


@pytest.mark.parametrize("off", [1e-12, -1e-12])
def test_equivalent_alternatives_have_fixed_order(off):
    """Two equivalent alternatives, whose sizes differ by rounding between libraries."""
    names = (("Qx", "K_I"), ("", "centrifuge.radius"), ("Qx", "K_F"))
    stated = tuple(Alternative("prior", *name) for name in names)
    u = np.array([1.0, 3.0, 2.0])
    size = 8.0 * np.array([1.0 + off, 1.0, 1.0 - off])
    actual_ranking = ranking._rank_rivals(
        ScoreTests(stated, size * u, u, size, 1e4), int(np.argmax(size)), True
    )
    assert actual_ranking.alternative.symbol == "centrifuge.radius"
    assert [other.symbol for other, _ in actual_ranking.rivals] == ["K_I", "K_F"]


def test_common_tilt_of_all_runs_is_single_alternative(tmp_path):
    given = Campaigns(tmp_path, CORRECT_DESCRIPTION, 0.0)
    estimation = estimate(given.clean, given.model, make_noise(given.campaign))
    terms = {
        Considered(run, "platform.tilt.up", (0.0, 0.0), 1e-2): 5e-5
        for run in ("slow", "middle", "fast")
    }
    *single, together = mistakes.term_mistakes(estimate_considered(estimation.fit), terms)
    assert [other.name for other in single] == [f"{run}.platform.tilt.up" for run in RUNS]
    assert together.name == "platform.tilt.up"
    for i, column in together.columns.items():
        (own,) = (other.columns[i] for other in single if i in other.columns)
        np.testing.assert_array_equal(column, own)


@pytest.mark.parametrize(
    ("value", "first"), [(-1.74, "K_OQ"), (-1.6, "site.latitude"), (0.01, "site.latitude")]
)
def test_distant_latitude_ranks_after_equivalent_term(value, first):
    """0.8 rad is stated: -0.94 is far from it and from -0.8, the value with a wrong sign."""
    latitude = Alternative(
        "input",
        "",
        "site.latitude",
        credible_range=(-2.0, 2.0),
        default_sd=5e-6,
        stated=True,
        likely_values=(0.0, -1.6),
        likely_tolerance=math.radians(1.0),
    )
    large = Alternative("term", "Qx", "K_OQ", default_sd=1e-6, credible_range=(-1e-3, 1e-3))
    values = np.array([value, 5e-4])
    size = np.array([8.0, 8.0])
    every = ScoreTests((latitude, large), values, np.abs(values) / size, size, 1e4)
    actual_ranking = ranking._rank_rivals(every, 0, True)
    assert actual_ranking.alternative.symbol == first
    assert len(actual_ranking.rivals) == 1


@pytest.mark.parametrize(("records", "shift", "suspicious"), [(3, 3.1, True), (3, 2.9, False)])
@pytest.mark.parametrize(("more", "extra"), [(0, 0.0), (297, 1.2)])
def test_suspicion_threshold_depends_on_number_of_shifts(
    monkeypatch, records, shift, suspicious, more, extra
):
    """Among 3 shifts one above 3 is suspicious; among 300 one above 4.15 (two-sided 0.01/300)."""
    monkeypatch.setattr(search, "_statistic_findings", lambda *_: ())
    view = SimpleNamespace(name="A", has_records=False, records=lambda: range(records + more))
    line = SimpleNamespace(z=shift + extra, dof=math.inf)
    result = SimpleNamespace(findings=[], jackknife=[line], two_stage=None)
    assert search._is_suspicious([view], {"A": result}) is suspicious
