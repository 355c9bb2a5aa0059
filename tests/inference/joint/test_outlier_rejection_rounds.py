"""Outliers among residuals: what is found, what good data lose, what wander is left alone."""

import math

import numpy as np
import pytest

from counterspin.inference.joint.outlier_rejection import (
    EXPECTED_FALSE_ALARMS,
    _pair_median,
    outlier_mask,
)


def reject_all_rounds(residuals, weight=None, floor=0.0, time=None):
    """Reject outliers until none remain, as the joint fit does, with a perfect fit."""
    weight = np.ones(residuals.size) if weight is None else weight
    mask = np.zeros(residuals.size, dtype=bool)
    while (
        outlier_mask_result := outlier_mask(np.where(mask, np.nan, residuals), weight, floor, time)
    ).any():
        assert not (outlier_mask_result & mask).any()
        mask |= outlier_mask_result
    return mask


def random_walk(order, n, rng):
    """Return a random walk with unit steps, integrated once or twice."""
    steps = rng.standard_normal(n)
    for _ in range(order):
        steps = np.cumsum(steps)
    return steps


@pytest.mark.parametrize(("size", "series"), [(800, 600), (5000, 100)])
def test_false_rejections_match_stated_rate(size, series):
    rng = np.random.default_rng(1)
    lost = sum(int(reject_all_rounds(rng.standard_normal(size)).sum()) for _ in range(series))
    # The scale is itself estimated, to 3 % in short series: this doubles the rate there.
    expected = EXPECTED_FALSE_ALARMS * series
    assert lost < 2 * expected + 4 * math.sqrt(2 * expected)


@pytest.mark.parametrize("height", [0.07, 0.2, 5.0, 500.0])
@pytest.mark.parametrize("share", [0.005, 0.05])
def test_spikes_are_found_at_any_row(height, share):
    rng = np.random.default_rng(2)
    n, sigma = 5000, 0.01
    planted = rng.random(n) < share
    planted[[0, n - 1]] = True
    spikes = height * rng.choice([-1.0, 1.0], n)
    rejection = reject_all_rounds(sigma * rng.standard_normal(n) + planted * spikes)
    # Five standard deviations is the limit; at seven a fortieth hides behind its own noise.
    hidden = np.count_nonzero(planted & ~rejection)
    assert hidden <= (0.08 * planted.sum() if height < 0.1 else 0)
    assert np.count_nonzero(rejection & ~planted) <= 1


def test_slow_wander_neither_is_nor_hides_outliers():
    rng = np.random.default_rng(3)
    n = 4000
    wander = 3.0 * np.sin(np.linspace(0.0, 12.0, n))  # three hundred times the noise
    residuals = wander + 0.01 * rng.standard_normal(n)
    assert not reject_all_rounds(residuals).any()
    residuals[[700, 2500]] += 0.15
    np.testing.assert_array_equal(np.flatnonzero(reject_all_rounds(residuals)), [700, 2500])


def test_short_block_may_be_noisier_than_long_block():
    rng = np.random.default_rng(4)
    n = 3000
    count = np.where(np.arange(n) % 100 == 99, 1.0, 25.0)
    residuals = rng.standard_normal(n) / np.sqrt(count)
    assert reject_all_rounds(residuals, np.sqrt(count)).sum() <= 1
    # Taken as equals, single samples stand out five times farther.
    assert reject_all_rounds(residuals).sum() > 5


def test_quantisation_steps_are_not_outliers():
    rng = np.random.default_rng(5)
    residuals = 0.01 * np.round(2e-3 * rng.standard_normal(3000) / 0.01)  # mostly zero
    step = 0.01
    assert np.count_nonzero(residuals)
    assert not reject_all_rounds(residuals, floor=step / math.sqrt(12)).any()
    residuals[1234] = 0.05
    rejection = reject_all_rounds(residuals, floor=step / math.sqrt(12))
    np.testing.assert_array_equal(np.flatnonzero(rejection), [1234])


@pytest.mark.parametrize("samples", [1, 63, 64])
def test_too_few_samples_have_no_outliers(samples):
    spiky = np.zeros(samples)
    spiky[samples // 2] = 1e3
    assert not outlier_mask(spiky, np.ones(samples)).any()


@pytest.mark.parametrize("order", [1, 2])
def test_random_walk_neither_is_nor_hides_outliers(order):
    rng = np.random.default_rng([6, order])
    n, series = 1000, 60
    alone = beside = missed = spikes = 0
    for _ in range(series):
        residuals = random_walk(order, n, rng)
        alone += reject_all_rounds(residuals).sum()
        # From e^5 steps on: beyond what the walk does within four samples.
        planted = rng.random(n) < 0.01
        size = rng.choice([-1.0, 1.0], n) * np.exp(rng.uniform(5, 9, n))
        rejection = reject_all_rounds(residuals + planted * size)
        spikes += planted.sum()
        missed += (planted & ~rejection).sum()
        beside += (rejection & ~planted).sum()
    # At 0.01 a series, and as much again for the scale's own error; none runs away.
    assert alone <= 2 * series * EXPECTED_FALSE_ALARMS + 4 * math.sqrt(
        2 * series * EXPECTED_FALSE_ALARMS
    )
    assert missed == 0
    # A spike among the neighbours may cost a good sample.
    assert beside < 0.3 * spikes


def test_gap_in_random_walk_is_not_outlier():
    rng = np.random.default_rng(7)
    lost = 0
    for _ in range(40):
        time = np.delete(np.arange(1500.0), np.r_[300:340, 341:360, 900:1100])
        residuals = random_walk(2, 1500, rng)[time.astype(int)]
        lost += reject_all_rounds(residuals, time=time).sum()
    assert lost <= 4


def test_rejected_samples_are_not_found_again():
    rng = np.random.default_rng(8)
    residuals = rng.standard_normal(500)
    residuals[[100, 101, 102, 300]] = [np.nan, np.nan, np.nan, 50.0]
    assert np.flatnonzero(outlier_mask(residuals, np.ones(500))).tolist() == [300]


@pytest.mark.parametrize("apart", [range(1, 5), range(1, 17), range(2, 33, 2)])
def test_median_of_pairs_matches_pair_means(apart):
    values = np.random.default_rng(11).standard_normal(200)
    pair_median, variance = _pair_median(values, apart)
    reach = apart[-1]
    expected = [
        np.median([0.5 * (values[i - k] + values[i + k]) for k in apart])
        for i in range(reach, values.size - reach)
    ]
    np.testing.assert_array_equal(pair_median, expected)
    assert variance == pytest.approx(math.pi / 4 / len(apart))
