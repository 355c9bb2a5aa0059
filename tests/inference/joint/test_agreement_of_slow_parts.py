"""A bend of one record that was taken for noise of the accelerometer stands out among the runs."""

from dataclasses import replace

import numpy as np
import pytest
from joint_campaign import add_noise, make_unknowns, simulate_three_rates
from scipy.stats import f as fisher

from counterspin.inference.joint.agreement import _slow_cosines, compare_slow_residuals
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.fit import augment, estimate_considered
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.noise.model import ESTIMATE, Noise

TRUTH = {"K_F": 0.005, "K_I": 1.002, "K_II": 2.7e-5}
MODEL = Unknowns(make_unknowns(["K_F", "K_I", "K_II"]))
NOISE = Noise(0.01, 3e-4)


def fitted(noise, bend=0.0):
    rng = np.random.default_rng(5)
    series = [add_noise(record, noise, rng) for record in simulate_three_rates(TRUTH)]
    phase = np.pi * series[2].time / series[2].time[-1]
    series[2] = replace(series[2], error=series[2].error + bend * np.sin(phase))
    estimation = estimate(series, MODEL, {"Qx": Noise(ESTIMATE, ESTIMATE)}, rejects_outliers=False)
    return estimation.estimated_noise["Qx"], estimate_considered(estimation.fit)


@pytest.fixture(scope="module")
def walking():
    return fitted(NOISE)[1]


def test_ratio_matches_gain_of_cosine_fits(walking):
    gains, counts = [], []
    for i, part in enumerate(walking.design_blocks):
        columns = [{i: column} for column in _slow_cosines(walking, part)]
        free = [Unknown("", str(k), (0.0, np.inf), 1e3) for k in range(len(columns))]
        whole = augment(walking, free, columns).solution
        gains.append(walking.solution.chi2 - whole.chi2)
        counts.append(len(columns))
    comparison = compare_slow_residuals(walking, "Qx")
    assert [part.run for part in comparison] == [part.run for part in walking.design_blocks]
    for k, part in enumerate(comparison):
        new_gains, others = sum(gains) - gains[k], sum(counts) - counts[k]
        ratio = gains[k] / counts[k] / (new_gains / others)
        assert part.ratio == pytest.approx(ratio, rel=1e-3)
        assert part.p == pytest.approx(fisher.sf(ratio, counts[k], others), rel=1e-2)


def test_common_random_walk_is_consistent(walking):
    assert min(part.p for part in compare_slow_residuals(walking, "Qx")) > 0.01


def test_bend_of_single_run_is_inconsistent():
    components, fit = fitted(Noise(0.01), bend=1.0)
    assert "random_walk" in components.estimated
    comparison = compare_slow_residuals(fit, "Qx")
    worst = min(comparison, key=lambda part: part.p)
    assert worst.run == fit.design_blocks[2].run
    assert worst.p < 1e-6
    assert worst.ratio > 5.0


def test_single_record_is_not_compared(walking):
    assert (
        compare_slow_residuals(replace(walking, observations=walking.design_blocks[:1]), "Qx") == []
    )
