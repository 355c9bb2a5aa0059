"""The filter of a walk: row after row it finds what the scan over all rows finds."""

import math

import numpy as np
import pytest

from counterspin.inference.noise.riccati import BlockSpans, filter_walk


@pytest.mark.parametrize("ratio", [0.0, 1e-30, 1e-16, 1e-8, 1.0, 1e12, math.inf])
@pytest.mark.parametrize(("samples", "rows"), [(1.0, 4), (1.0, 200), (8.0, 200)])
def test_row_after_row_is_the_scan(ratio, samples, rows):
    """Whatever the walk's share is; uneven rows, whose rounding a large walk multiplies."""
    rng = np.random.default_rng(1)
    time = np.cumsum(rng.uniform(0.5, 1.5, rows))
    blocks = BlockSpans.of(time, np.full(rows, samples), np.full(rows, 0.04))
    white, walk = (1.0, ratio) if ratio < math.inf else (0.0, 1.0)
    in_turn, scan = (filter_walk(blocks, white, walk, few_rows=few) for few in (rows, 0))
    np.testing.assert_allclose(in_turn.variance, scan.variance, rtol=1e-11)
    np.testing.assert_allclose(in_turn.gain, scan.gain, rtol=1e-11)
    np.testing.assert_array_equal((in_turn.ahead, in_turn.step), (scan.ahead, scan.step))
