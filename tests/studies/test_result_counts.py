"""What trials amount to, against the same from all trials at once."""

import numpy as np
import pytest
from scipy import stats

from counterspin.physics.spindle import Spindle
from counterspin.studies.draws import DRIFT, StudyTruth, VariedQuantity, random_stream
from counterspin.studies.result import (
    CONFIDENCE_LEVELS,
    BiasCovariate,
    TrialAccumulator,
    binomial_interval,
    coverage_factor,
    summarise,
)


def test_merged_batches_match_all_trials():
    rng = np.random.default_rng(5)
    estimate, truth = rng.normal(3.0, 1e-3, 5000), rng.normal(2.0, 1e-4, 5000)
    u, dof = np.full(5000, 1.1e-3), np.full(5000, np.inf)
    driven = rng.uniform(0.0, 1.0, 5000)
    accumulator = TrialAccumulator((BiasCovariate(DRIFT, 0.0, 1.0),))
    parts = [slice(0, 700), slice(700, 5000)]
    sums = np.array(
        [accumulator.accumulate(estimate[p], truth[p], u[p], dof[p], [driven[p]]) for p in parts]
    )
    summary = summarise(accumulator, sums)
    error = estimate - truth
    assert summary.trials == 5000
    assert summary.bias == pytest.approx(error.mean(), rel=1e-12)
    assert summary.sd == pytest.approx(error.std(ddof=1), rel=1e-9)
    assert summary.mse == pytest.approx(np.mean(error**2), rel=1e-12)
    assert summary.truth == pytest.approx(truth.mean(), rel=1e-12)
    for level, share in zip(CONFIDENCE_LEVELS, summary.covered, strict=True):
        k = stats.norm.ppf(0.5 + level / 2)
        assert share == np.mean(np.abs(error / u) <= k)
    assert sum(summary.histogram) == 5000
    assert summary.histogram[-1] == 5000  # all far beyond 6 u
    counts, bias = summary.against[DRIFT].trials, summary.against[DRIFT].bias
    assert sum(counts) == 5000
    low = driven < 0.1
    assert counts[0] == low.sum()
    assert bias[0] == pytest.approx(error[low].mean(), rel=1e-12)


def test_coverage_uses_degrees_of_freedom_per_trial():
    rng = np.random.default_rng(6)
    z, dof = 3.0 * rng.standard_normal(20_000), rng.uniform(3.0, 60.0, 20_000)
    kept = TrialAccumulator(()).accumulate(z, np.zeros_like(z), np.ones_like(z), dof, [])
    summary = summarise(TrialAccumulator(()), kept[None])
    for level, share in zip(CONFIDENCE_LEVELS, summary.covered, strict=True):
        direct = np.mean(np.abs(z) <= stats.t.ppf(0.5 + level / 2, dof))
        # The table's error of 1e-5 may move a trial or two across.
        assert share == pytest.approx(direct, abs=3.0 / z.size)


@pytest.mark.parametrize("dof", [3.0, 20.0, 291.0, np.inf])
@pytest.mark.parametrize("level", CONFIDENCE_LEVELS)
def test_coverage_factor_matches_student_t(dof, level):
    expected = stats.t.ppf(0.5 + level / 2, dof)
    assert coverage_factor(np.array([dof]), level)[0] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("hits", "trials"), [(0, 50), (50, 50), (17, 50), (9500, 10000)])
def test_binomial_interval_matches_clopper_pearson(hits, trials):
    expected = stats.binomtest(hits, trials).proportion_ci(0.95, method="exact")
    assert binomial_interval(hits, trials) == pytest.approx((expected.low, expected.high), rel=1e-9)


def truth(*varying):
    fixed = {("Qx", "K_II"): np.array([2e-5])}
    return StudyTruth(fixed, (Spindle(1.0), Spindle(2.0)), {}, {}, 0.01, varying)


def test_draws_follow_stated_distributions():
    varying = (
        VariedQuantity("Qx", "K_II", "normal", 1e-5, 1e-6),
        VariedQuantity("", DRIFT, "uniform", -1e-7, 3e-7, is_per_run=True),
    )
    draws = truth(*varying).draw(random_stream(1, 0, 0), 4000)
    assert draws.drift.shape == (2, 4000)
    assert stats.kstest(draws.mean("Qx", "K_II"), "norm", (1e-5, 1e-6)).pvalue > 1e-3
    for row in draws.drift:
        assert stats.kstest(row, "uniform", (-1e-7, 4e-7)).pvalue > 1e-3
    # Independent from run to run: 4 / sqrt(4000)
    assert abs(np.corrcoef(draws.drift)[0, 1]) < 0.07


def test_random_streams_differ_by_batch_and_purpose():
    first = [random_stream(1, b, w).random() for b in (0, 1) for w in (0, 1)]
    assert len(set(first)) == 4
    assert random_stream(1, 1, 0).random() == first[2]
