"""Records at rest as recorders write them: gaps, spikes, rounded and uneven clocks."""

import numpy as np
import pytest

from counterspin.inference.noise.static_noise import MAX_SAMPLES, analyse, split_segments

STEP = 0.01


def record(n=4000, seed=1):
    rng = np.random.default_rng(seed)
    return np.round(np.arange(n) * STEP, 4), 9.8 + 1e-3 * rng.standard_normal(n)


def test_clean_record_is_single_segment():
    time, values = record()
    segments = split_segments(time, values)
    ((start, part),) = segments.segments
    assert start == 0.0
    np.testing.assert_allclose(part, values, atol=1e-12)
    assert (segments.rows, segments.outliers, segments.filled, segments.gaps) == (4000, 0, 0, 0)
    assert segments.step == pytest.approx(STEP, rel=1e-9)


def test_outliers_and_short_gaps_are_filled_and_long_gaps_split():
    time, values = record()
    values[[500, 900]] += 0.1
    values[700] = np.nan
    keep = np.ones(4000, bool)
    keep[1000:1002] = False
    keep[2000:2300] = False
    segments = split_segments(time[keep], values[keep])
    assert (segments.outliers, segments.filled, segments.gaps) == (2, 5, 1)
    assert [(start, part.size) for start, part in segments.segments] == [(0.0, 2000), (23.0, 1700)]
    between = 0.5 * (values[499] + values[501])
    assert segments.segments[0][1][500] == pytest.approx(between)


def test_rows_of_other_sensors_are_not_samples():
    """A log of two sensors with a row, and an empty cell, for each sample of the other."""
    time, values = record()
    rows = np.sort(np.append(time, time + 0.4 * STEP))
    segments = split_segments(rows, np.column_stack([values, np.full(4000, np.nan)]).ravel())
    assert (segments.filled, segments.gaps) == (0, 0)
    assert segments.sample_interval == pytest.approx(STEP, rel=1e-9)


def test_repeated_rows_count_once():
    time, values = record()
    again = np.insert(np.arange(4000), 100, 100)
    segments = split_segments(time[again], values[again])
    assert segments.segments[0][1].size == 4000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, v: (t[::-1], v), "the time decreases"),
        (lambda t, v: (np.cumsum(np.random.default_rng(1).uniform(0.2, 1.8, t.size)), v), "evenly"),
        (lambda t, v: (t[:20], v[:20]), "too few"),
        (lambda t, v: (t, np.where(np.arange(t.size) % 10 < 5, np.nan, v)), "without a gap"),
    ],
)
def test_invalid_record_raises(change, message):
    with pytest.raises(ValueError, match=message):
        split_segments(*change(*record()))


def test_segments_share_noise():
    """N of both parts lies in the interval, and they tell more than the longer one alone."""
    time, values = record(8000)
    keep = (time < 50.0) | (time > 51.0)
    both = analyse(split_segments(time[keep], values[keep]), 0).noise.components["random_walk"]
    alone = analyse(split_segments(time[:5000], values[:5000]), 0).noise.components["random_walk"]
    density = 1e-6 * STEP
    assert both.low < density < both.high
    assert both.high / both.low < alone.high / alone.low


def test_long_records_are_thinned_without_bias():
    rng = np.random.default_rng(2)
    n = MAX_SAMPLES + 10_000
    analysis = analyse(split_segments(np.arange(n) * STEP, 1e-3 * rng.standard_normal(n)), 0)
    assert analysis.step == pytest.approx(2.0 * STEP)
    size = analysis.noise.components["random_walk"]
    assert size.low < 1e-6 * STEP < size.high


def test_line_is_removed_before_noise_estimation():
    time, values = record()
    analysis = analyse(split_segments(time, values + 1e-3 * np.sin(2.0 * np.pi * 7.3 * time)), 0)
    (line,) = analysis.lines
    assert abs(line.frequency - 7.3) < 4.0 * line.u_frequency
    size = analysis.noise.components["random_walk"]
    assert size.low < 1e-6 * STEP < size.high
