"""White noise that differs between runs, or follows the slope: found, weighed, and nothing else."""

import math
from dataclasses import replace

import numpy as np
import pytest
from joint_campaign import add_noise, make_unknowns, simulate_three_rates

from counterspin.inference.joint.design_blocks import build_design_blocks
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.fit import solve_joint
from counterspin.inference.joint.heteroscedasticity import estimate_heteroscedasticity, noise_by_run
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import ESTIMATE, Noise

TRUTH = {"K_F": 5.03e-3, "K_I": 1.00197, "K_II": 2.7e-5}
MODEL = Unknowns(make_unknowns(TRUTH))
TRUE = np.array([TRUTH[u.symbol] - u.nominal for u in MODEL.unknowns])
WANT = {"Qx": Noise(ESTIMATE, 0.0)}
SIZES = {"run1": 0.01, "run2": 0.02, "run3": 0.05}
TIMING = 2e-4


@pytest.fixture(scope="module")
def noise_free_series():
    return simulate_three_rates(TRUTH)


def by_run(noise_free_series, rng):
    return [add_noise(record, Noise(SIZES[record.run]), rng) for record in noise_free_series]


def by_slope(noise_free_series, rng):
    """Add white noise and time-stamp jitter, which is proportional to the slope."""
    drawn = []
    for record in noise_free_series:
        late = TIMING * rng.standard_normal(record.time.size)
        moved = replace(record, error=record.error + sum(record.slopes()) * late)
        drawn.append(add_noise(moved, Noise(3e-4), rng))
    return drawn


def test_runs_are_weighted_by_separate_noise(noise_free_series):
    """u is that of the true weights, and 95 % intervals hold."""
    rng = np.random.default_rng(1)
    prepared = build_design_blocks(noise_free_series, MODEL, {"Qx": TRUTH["K_I"]})
    changed_ones = [
        replace(one, series=replace(one.series, variance_ratio=(SIZES[one.run] / 0.01) ** 2))
        for one in prepared
    ]
    bound = solve_joint(changed_ones, MODEL, {"Qx": Noise(0.01)}).solution.u
    trials, z, ratios = 30, [], []
    for _ in range(trials):
        estimation = estimate(by_run(noise_free_series, rng), MODEL, WANT)
        z.append((estimation.fit.solution.estimate - TRUE) / estimation.fit.solution.u)
        white = estimation.fit.noise["Qx"].white
        ratios.append(
            [
                white * math.sqrt(design_block.series.variance_ratio)
                for design_block in estimation.fit.design_blocks
            ]
        )
        # Each run's own size is known to 1/sqrt(2 x 385/2.31), 5.5 %.
        np.testing.assert_allclose(estimation.fit.solution.u, bound, rtol=4 * 0.055)
    squared = np.mean(np.square(z), axis=0)
    assert (np.abs(squared - 1.0) < 4.0 * math.sqrt(2.0 / trials)).all()
    sizes = list(SIZES.values())
    np.testing.assert_allclose(np.mean(ratios, axis=0), sizes, rtol=4 * 0.055 / math.sqrt(trials))


def test_time_jitter_is_estimated_from_slope(noise_free_series):
    rng = np.random.default_rng(2)
    trials, z, sizes = 6, [], []
    for _ in range(trials):
        # One row in 400 is taken for an outlier before the weights are known, and 2 % of the size.
        estimation = estimate(by_slope(noise_free_series, rng), MODEL, WANT, rejects_outliers=False)
        assert {record.variance_ratio for record in estimation.series} == {1.0}
        (timing,) = {record.timestamp_sd for record in estimation.series}
        sizes.append(timing / TIMING)
        z.append((estimation.fit.solution.estimate - TRUE) / estimation.fit.solution.u)
    squared = np.mean(np.square(z), axis=0)
    assert (np.abs(squared - 1.0) < 4.0 * math.sqrt(2.0 / trials)).all()
    # 1155 rows tell as much as 500 that are independent, 3.2 %; the white noise takes its share.
    assert np.std(sizes) < 0.08
    assert np.mean(sizes) == pytest.approx(1.0, abs=4.0 * 0.05 / math.sqrt(trials))


@pytest.mark.parametrize("observable", ["displacement", "velocity", "specific_force"])
def test_homoscedastic_noise_is_unchanged(observable):
    """Probability of 1e-6 each, and of what is no noise there is nothing in third differences."""
    rng = np.random.default_rng(3)
    noise_free_series = simulate_three_rates(TRUTH, observable=observable)
    for _ in range(10):
        drawn = [add_noise(record, Noise(0.01), rng) for record in noise_free_series]
        # A bend of one run, a hundred times its noise.
        bent = replace(drawn[2], error=drawn[2].error + np.sin(drawn[2].time / 3.0))
        estimation = estimate([*drawn[:2], bent], MODEL, WANT, rejects_outliers=False)
        assert {(record.variance_ratio, record.timestamp_sd) for record in estimation.series} == {
            (1.0, 0.0)
        }


def test_spindle_harmonics_are_not_noise():
    """An encoder that errs four times a revolution leaves a fifth harmonic, with the force."""
    rng = np.random.default_rng(5)
    drawn = []
    for record in simulate_three_rates(TRUTH, observable="specific_force"):
        wave = 3e-3 * record.trajectory.spindle.rate**2
        wave = wave * np.cos(5.0 * record.trajectory.spindle.angle(record.time))
        drawn.append(add_noise(replace(record, error=record.error + wave), Noise(0.01), rng))
    stated, estimated = {"Qx": Noise(0.01)}, {"Qx": Noise(ESTIMATE)}
    fit = estimate(drawn, MODEL, stated, rejects_outliers=False).fit
    assert noise_by_run(fit, "Qx") == {}
    assert estimate_heteroscedasticity(fit, drawn, estimated) == {}
    # Another noise shows beneath them.
    louder = [*drawn[:2], add_noise(drawn[2], Noise(0.02), rng)]
    sizes = noise_by_run(estimate(louder, MODEL, stated, rejects_outliers=False).fit, "Qx")
    assert sizes["run3"] == pytest.approx(math.sqrt(5.0), rel=0.15)
    assert sizes["run1"] == pytest.approx(1.0, rel=0.15)


def test_stated_noise_and_short_records_are_unchanged(noise_free_series):
    rng = np.random.default_rng(4)
    drawn = by_run(noise_free_series, rng)
    estimation = estimate(drawn, MODEL, {"Qx": Noise(0.02)})
    assert {record.variance_ratio for record in estimation.series} == {1.0}
    few = [record.drop_rows(np.arange(record.time.size) > 40) for record in drawn]
    fit = estimate(few, MODEL, WANT, rejects_outliers=False).fit
    assert estimate_heteroscedasticity(fit, few, WANT) == {}
