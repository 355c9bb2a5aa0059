"""The filter of a walk: row after row it finds what the scan over all rows finds."""

import math

import numpy as np
import pytest

from counterspin.inference.noise.riccati import BlockSpans, filter_walk


@pytest.mark.parametrize("ratio", [0.0, 1e-30, 1e-16, 1e-8, 1.0, 1e12, math.inf])
@pytest.mark.parametrize(("samples", "rows"), [(1.0, 4), (1.0, 200), (8.0, 200)])
def test_sequential_solution_matches_scan(ratio, samples, rows):
    """Whatever the walk's share is; uneven rows, whose rounding a large walk multiplies."""
    rng = np.random.default_rng(1)
    time = np.cumsum(rng.uniform(0.5, 1.5, rows))
    blocks = BlockSpans.from_blocks(time, np.full(rows, samples), np.full(rows, 0.04))
    white, walk = (1.0, ratio) if ratio < math.inf else (0.0, 1.0)
    in_turn, scan = (filter_walk(blocks, white, walk, max_sequential_rows=few) for few in (rows, 0))
    np.testing.assert_allclose(in_turn.variance, scan.variance, rtol=1e-11)
    np.testing.assert_allclose(in_turn.gain, scan.gain, rtol=1e-11)
    np.testing.assert_array_equal((in_turn.ahead, in_turn.step), (scan.ahead, scan.step))


@pytest.mark.parametrize("ratio", [0.0, 1e-30, 1e-16, 1e-8, 1.0, 1e12, math.inf])
@pytest.mark.parametrize("samples", [1.0, 8.0])
def test_segments_of_equal_rows_match_scan(ratio, samples):
    """Even rows with gaps, a shorter block at the end, and times that were rounded."""
    rows = np.r_[0:700, 703:710, 712:900, 1000:1400]
    count = np.full(rows.size, samples)
    count[-1] = 1.0
    time = np.round(rows * 0.4 * samples, 9)
    blocks = BlockSpans.from_blocks(time, count, np.full(rows.size, 0.05))
    white, walk = (1.0, ratio) if ratio < math.inf else (0.0, 1.0)
    alike, scan = (
        filter_walk(blocks, white, walk, max_sequential_rows=few) for few in (rows.size, -1)
    )
    # A large walk multiplies what rounding the times has moved.
    np.testing.assert_allclose(alike.variance, scan.variance, rtol=2e-9)
    np.testing.assert_allclose(alike.gain, scan.gain, rtol=2e-9)
