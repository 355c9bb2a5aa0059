"""Triangular factors: R of a matrix does not depend on how its rows are taken."""

import numpy as np
import pytest

from counterspin.arrays import (
    QR_BLOCK_ROWS,
    empty_aligned,
    qr_blocks,
    quantile,
    semidefinite_root,
    triangular_factor,
    triangular_root,
)


@pytest.mark.parametrize(
    "rows", [0, 3, QR_BLOCK_ROWS - 1, QR_BLOCK_ROWS, QR_BLOCK_ROWS + 1, 3 * QR_BLOCK_ROWS + 7]
)
@pytest.mark.parametrize("order", ["C", "F"])
def test_chunked_qr_has_same_triangle(rows, order):
    matrix = np.asarray(np.random.default_rng(rows).standard_normal((rows, 5)), order=order)
    parts = qr_blocks(matrix)
    assert len(parts) == rows // QR_BLOCK_ROWS * 5 + rows % QR_BLOCK_ROWS
    expected = matrix.T @ matrix
    triangle = triangular_factor(parts)
    assert not np.tril(triangle, -1).any()
    np.testing.assert_allclose(triangle.T @ triangle, expected, rtol=0, atol=1e-13 * (rows + 1))


def test_covariance_root_is_unique_triangular_factor():
    factor = np.random.default_rng(1).standard_normal((4, 6))
    root = triangular_root(factor)
    np.testing.assert_allclose(root, np.linalg.cholesky(factor @ factor.T), rtol=0, atol=1e-13)


def test_covariance_root_has_full_precision_in_all_units():
    factor = np.random.default_rng(2).standard_normal((4, 6)) * [[1e-9], [1.0], [0.0], [1e6]]
    root = semidefinite_root(factor @ factor.T)
    assert not root[2].any()
    scale = np.linalg.norm(factor, axis=1)
    scale[2] = 1.0
    expected = factor @ factor.T / np.outer(scale, scale)
    np.testing.assert_allclose(root @ root.T / np.outer(scale, scale), expected, atol=1e-14)


def test_inconsistent_contributions_decrease_no_variance():
    impossible = np.array([[1.0, 0.9, -0.9], [0.9, 1.0, 0.9], [-0.9, 0.9, 1.0]])
    root = semidefinite_root(impossible)
    covariance = root @ root.T
    # What three sums of rounded products and the eigenvalues themselves may be off by.
    rounding = 3 * 4 * np.finfo(float).eps * np.linalg.norm(covariance, 2)
    assert np.linalg.eigvalsh(covariance - impossible)[0] > -rounding


@pytest.mark.parametrize("shape", [(1,), (1000,), (3, 65), (511, 128)])
def test_work_arrays_are_aligned_to_cache_lines(shape):
    array = empty_aligned(*shape)
    assert array.shape == shape
    rows = array.reshape(-1, shape[-1]) if array.flags.c_contiguous else array
    assert all(row.ctypes.data % 64 == 0 for row in rows)


@pytest.mark.parametrize("size", [1, 2, 3, 10, 1001])
def test_quantile_matches_numpy(size):
    values = np.random.default_rng(size).normal(size=size)
    for fraction in (0.0, 0.01, 0.5, 0.999, 1.0):
        assert quantile(values, fraction) == pytest.approx(np.quantile(values, fraction), rel=1e-12)
    values[0] = np.nan
    assert np.isnan([quantile(values, 0.5), quantile(values[:0], 0.5)]).all()
