"""Rows behind a filter: found, thinned until they are independent, and nothing else is."""

import math
import os
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from joint_campaign import add_noise, make_unknowns, simulate_series, simulate_three_rates
from scipy.signal import lfilter
from scipy.stats import chi2

from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import ESTIMATE, Noise

FULL = bool(os.environ.get("COUNTERSPIN_FULL"))
TRUTH = {"K_F": 5.03e-3, "K_I": 1.00197, "K_II": 2.7e-5}
MODEL = Unknowns(make_unknowns(TRUTH))
TRUE = np.array([TRUTH[u.symbol] - u.nominal for u in MODEL.unknowns])


def add_filtered_noise(series, size, memory, rng):
    """The series with noise whose correlation falls by e over a time, in s."""
    rho = math.exp(-series.spacing / memory)
    white = size * math.sqrt(1.0 - rho**2) * rng.standard_normal(series.time.size + 200)
    return replace(series, error=series.error + lfilter([1.0], [1.0, -rho], white)[200:])


@pytest.mark.parametrize(
    "request_", [Noise(ESTIMATE, ESTIMATE), Noise(0.01)], ids=["found", "stated"]
)
def test_filtered_rows_are_thinned(request_):
    """u holds, where it was 2 to 4 times too small of rows that are taken as independent."""
    clean = simulate_three_rates(TRUTH, revolutions=40)
    rng = np.random.default_rng(1)
    trials, z = 30 if FULL else 10, []
    for _ in range(trials):
        drawn = [add_filtered_noise(one, 0.01, 0.25, rng) for one in clean]
        estimation = estimate(drawn, MODEL, {"Qx": request_})
        apart = {record.thinning * record.spacing for record in estimation.series}
        assert min(apart) == pytest.approx(max(apart), rel=0.3)
        assert min(apart) >= 0.5
        z.append((estimation.fit.solution.estimate - TRUE) / estimation.fit.solution.u)
    squared = np.mean(np.square(z), axis=0)
    # Two memories apart rows still have a correlation of 13 %: up to 30 % of the variance.
    assert (squared < 1.3 + 4.0 * math.sqrt(2.0 / trials)).all()
    # K_F has room for noise of the accelerometer that does not show.
    assert (trials * squared[1:] > chi2.ppf(1e-4, trials)).all()


@pytest.mark.parametrize(
    ("observable", "walk"),
    [("specific_force", 0.0), *product(("displacement", "velocity"), (0.0, 2e-3, 2e-2))],
)
def test_unfiltered_rows_are_not_thinned(observable, walk):
    rng = np.random.default_rng(2)
    clean = simulate_three_rates(TRUTH, observable=observable, revolutions=40)
    for shaking in (False, True):
        drawn = [add_noise(one, Noise(0.01, walk), rng) for one in clean]
        if shaking:
            shaken = 0.02 * np.sin(7.3 * drawn[1].time)
            drawn[1] = replace(drawn[1], error=drawn[1].error + shaken)
        want = Noise(ESTIMATE, 0.0 if observable == "specific_force" else ESTIMATE)
        estimation = estimate(drawn, MODEL, {"Qx": want})
        assert {record.thinning for record in estimation.series} == {1}


def test_spindle_harmonics_are_not_filter_memory():
    """An encoder that errs four times a revolution leaves a fifth harmonic in specific force."""
    rng = np.random.default_rng(3)
    drawn = []
    for rate, revolutions in ((3.72, 18), (4.77, 31), (5.34, 24), (5.56, 39), (-2.58, 24)):
        rows = round(math.tau / abs(rate) * (50 if rate > 5.5 else 25))
        more = {"revolutions": revolutions, "per_revolution": rows}
        series = simulate_series(f"{rate}", rate, TRUTH, observable="specific_force", **more)
        wave = 1e-4 * rate**2 * np.cos(5.0 * series.trajectory.spindle.angle(series.time))
        drawn.append(add_noise(replace(series, error=series.error + wave), Noise(1e-4), rng))
    estimation = estimate(drawn, MODEL, {"Qx": Noise(ESTIMATE)})
    assert {record.thinning for record in estimation.series} == {1}
